"""One method that is compared: what it is called, what it does, and what was spent on it before it runs."""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

_FILES = ("bed", "model", "cases")  # of a job: files whose names or digests say what they hold


@dataclass(frozen=True)
class Method:
    """A method on a scene.

    Attributes:
        name: for people, unique among those that are compared.
        kind: ``dem``, ``surrogate`` or ``baseline``.
        job: what a worker does, as plain data (`jobs.prepare`); empty where the method does not fit the scene.
        seconds: of the scene that one run of the job covers.
        data_seconds: wall time of the data that it was made from, s.
        training_seconds: wall time of its training, s.
        judged: whether a run covers the whole scene, so that its error is known.
        unfit_because: why it cannot answer for this scene; empty where it can.
    """

    name: str
    kind: str
    job: dict[str, Any]
    seconds: float
    data_seconds: float = 0.0
    training_seconds: float = 0.0
    judged: bool = True
    unfit_because: str = ""

    def key(self, *conditions: str) -> str:
        """A readable name of the method's files, with a hash of the job, how long it is, and under which conditions.

        Args:
            conditions: whatever else decides a measurement: code, hardware.
        """
        plain = {name: _file_names(value) if name in _FILES else value for name, value in self.job.items()}
        text = json.dumps([plain, self.seconds, *conditions], sort_keys=True)
        digest = hashlib.sha256(text.encode()).hexdigest()[:12]
        return re.sub(r"[^\w.+-]+", "-", self.name).strip("-") + f"-{digest}"


def _file_names(value: Any) -> Any:
    """Without the folders that files are in: the same data in another place are the same data."""
    return {key: Path(path).name for key, path in value.items()} if isinstance(value, dict) else Path(value).name

"""Say in one line what Hydra, OmegaConf or a full disk says in many, and name the nearest right word."""

from __future__ import annotations

import errno
import re
from difflib import get_close_matches
from pathlib import PurePosixPath

from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from gran_bench.config_check import unknown_key


def explain(error: Exception, schema: type) -> str | None:
    """One line for an error that was written for people; None for any other, which is a bug and needs its traceback.

    Args:
        error: of this package, of Hydra, of OmegaConf or of a YAML file.
        schema: of the whole config, for the nearest right key.
    """
    if isinstance(error, MissingConfigException):
        return _missing_choice(error)
    if isinstance(error, OverrideParseException):
        return f"{error.override}: not KEY=VALUE as Hydra reads it; quote a value that has spaces or symbols"
    if isinstance(error, HydraException):
        return _composition(str(error), schema)
    if isinstance(error, OmegaConfBaseException):
        key = getattr(error, "full_key", None)
        return f"{key}: {_first_line(error)}" if key else _first_line(error)
    if is_full_disk(error):
        where = f" {error.filename}" if error.filename else ""
        return (
            f"the disk takes no more ({error.strerror}{where}); free space, and the same command goes on from here: "
            "what is finished is whole"
        )
    if isinstance(error, YAMLError) or type(error).__module__.startswith("gran_bench."):
        return " ".join(str(error).split())
    return None


def is_full_disk(error: Exception) -> bool:
    """Whether the system refused to write for want of space, quota or permitted file size."""
    return isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def _missing_choice(error: MissingConfigException) -> str:
    """A group has no such choice, or there is no such primary config."""
    missing = PurePosixPath(error.missing_cfg_file or "")
    group, choice, options = str(missing.parent), missing.name, list(error.options or [])
    if not options:
        return _first_line(error)
    guesses = get_close_matches(choice, options, n=1, cutoff=0.65)
    listed = ", ".join(options)
    meant = f"did you mean {guesses[0]}? ({listed})" if guesses else f"choose {' or '.join(options)}"
    return f"{group}={choice}: no such choice; {meant}"


def _composition(message: str, schema: type) -> str:
    """Hydra could not put the config together."""
    if found := re.search(r"Could not override '([^']+)'\. No match in the defaults list", message):
        group = found[1]
        added = re.search(r"use (\+\S+)", message)
        return f"{group}: not chosen yet, so it cannot be changed; write {added[1] if added else '+' + group}"
    if found := re.search(r"Could not override '([^']+)'\.?\s+To append to your config use \+(\S+)=(.*)", message):
        return str(unknown_key(found[1], found[3].strip(), schema))
    if found := re.search(r"Could not append to config\. An item is already at '([^']+)'", message):
        return f"+{found[1]}: the key is there already; write {found[1]}=VALUE without +"
    if found := re.search(r"Ambiguous value for argument '([^']+)'", message):
        return f"{found[1]}: several values; add -m to run each, or write KEY=[A,B] for a list"
    return _first_line(Exception(message))


def _first_line(error: Exception) -> str:
    return next((line.strip() for line in str(error).splitlines() if line.strip()), type(error).__name__)

"""Where a result comes from: command, commit, day, hardware, versions. Every result file carries this."""

import json
import os
import platform
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from datetime import date
from importlib.metadata import version
from pathlib import Path

import psutil

import gran_bench
from gran_bench.files import write_text

# Whatever decides a figure: the libraries whose numerics a run goes through.
LIBRARIES = ("numpy", "scipy", "numba", "torch")

# Vector units of x86 processors by their flag, the widest first.
VECTORS = {"avx512f": "AVX-512", "avx2": "AVX2", "sse4_2": "SSE4.2"}

_remembered: str | None = None


def hardware() -> str:
    """One line: processor and the width of its vectors, by which jitted kernels go, cores, memory, accelerator."""
    import torch  # only here: it loads for seconds

    listed = Path("/proc/cpuinfo")
    facts = dict(re.findall(r"^([\w ]+?)\s*: (.*)$", listed.read_text(), re.MULTILINE)) if listed.exists() else {}
    processor = facts.get("model name") or platform.processor() or platform.machine()
    vectors = next((f" ({name})" for flag, name in VECTORS.items() if flag in facts.get("flags", "").split()), "")
    memory = psutil.virtual_memory().total / 2**30
    accelerator = torch.cuda.get_device_name() if torch.cuda.is_available() else "no GPU"
    return f"{processor}{vectors}, {os.cpu_count()} cores, {memory:.0f} GiB, {accelerator}"


def commit() -> str:
    """The checked-out commit, with ``+`` where the tree has changes but in ``results/``; of a wheel its version."""
    folder = Path(gran_bench.__file__).resolve().parents[2]
    if not (folder / ".git").exists():
        return f"version {gran_bench.__version__}"

    def git(*arguments: str) -> str:
        return subprocess.run(["git", "-C", folder, *arguments], capture_output=True, text=True, check=False).stdout

    head = shutil.which("git") and git("rev-parse", "--short=12", "HEAD").strip()
    if not head:  # which must not cost a result
        return "no commit"
    changed = git("status", "--porcelain", "--untracked-files=no", "--", ":(top)", ":(top,exclude)results")
    return head + ("+" if changed else "")


def program() -> list[str]:
    """The first words of this process's command line, before its arguments."""
    spec = getattr(sys.modules.get("__main__"), "__spec__", None)
    if spec is None:
        return ["python", Path(sys.argv[0]).name]
    return ["python", "-m", spec.name.removesuffix(".__main__")]


def remember_command(words: Sequence[str]) -> None:
    """Let `command` say ``words`` from now on: in a worker process the process's own command line is another."""
    global _remembered
    _remembered = shlex.join(words)


def command() -> str:
    """The command line as a user would type it, quoted for a shell: the remembered one, or this process's own."""
    return _remembered if _remembered is not None else shlex.join([*program(), *sys.argv[1:]])


def library_versions() -> str:
    """One line: the versions of the libraries whose numerics a run goes through."""
    return ", ".join(f"{name} {version(name)}" for name in LIBRARIES)


def provenance() -> dict[str, str]:
    """Command, commit, day, hardware, Python and library versions."""
    return {
        "command": command(),
        "commit": commit(),
        "day": date.today().isoformat(),
        "hardware": hardware(),
        "python": platform.python_version(),
        "versions": library_versions(),
    }


def stamp(made: Mapping[str, str]) -> str:
    """Where a record comes from, as `provenance` gives it, in one line of Markdown."""
    said = {"command": "`{}`", "commit": "commit `{}`", "day": "{}", "hardware": "{}"}
    return f"*{', '.join(words.format(made[name]) for name, words in said.items() if made.get(name))}*"


def write_table(path: Path, table: str, made: Mapping[str, str]) -> Path:
    """Write a table in CSV below a comment that says where it comes from, as `provenance` gives it or more."""
    write_text(path, f"# {json.dumps(dict(made), ensure_ascii=False)}\n{table}")
    return path


def read_table(path: Path) -> tuple[dict[str, str], str]:
    """Where a CSV of `write_table` comes from, and the table in CSV."""
    first, _, table = path.read_text("utf-8").partition("\n")
    return json.loads(first.removeprefix("#")), table

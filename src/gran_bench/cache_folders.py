"""Where Numba and Matplotlib keep what they have compiled or looked up, if their own folders cannot be written.

Numba refuses to define a kernel that it has no place to keep, and Matplotlib makes a new folder for each process.
"""

import os
import stat
import sys
import tempfile
from pathlib import Path


def provide_cache_folders() -> None:
    """Name to each library that has none of its own a temporary folder, the same for every command of a user."""
    home, numba, matplotlib = Path(os.path.expanduser("~")), "NUMBA_CACHE_DIR", "MPLCONFIGDIR"
    if not home.is_absolute():  # of a user without any
        home = Path(os.devnull)
    cache = Path(os.environ.get("XDG_CACHE_HOME") or home / ".cache")
    config = Path(os.environ.get("XDG_CONFIG_HOME") or home / ".config")
    # The user's choice, or the library's own places: Numba takes any, Matplotlib needs both.
    kernels = [*filter(None, [os.environ.get(numba)]), Path(__file__).parent / "__pycache__", cache / "numba"]
    fonts = [*filter(None, [os.environ.get(matplotlib)])] or [config / "matplotlib", cache / "matplotlib"]
    missing = {}
    if not any(map(_is_writable, kernels)):
        missing[numba] = "compiled kernels"
    if not all(map(_is_writable, fonts)):
        missing[matplotlib] = "a list of fonts"
    if not missing:
        return
    try:
        folder = _temporary()
    except OSError:  # no place at all; the libraries say so themselves
        return
    os.environ.update(dict.fromkeys(missing, str(folder)))
    if numba in missing and "numba" in sys.modules:  # which has read its variable already
        sys.modules["numba"].config.CACHE_DIR = str(folder)
    print(
        f"no folder of this user's can be written to keep {' and '.join(missing.values())} in: {folder} is used "
        f"({' and '.join(missing)} would choose another)",
        file=sys.stderr,
        flush=True,
    )


def _is_writable(folder: Path | str) -> bool:
    """Whether files can be made in a folder, which may be still to be made."""
    folder = Path(folder).absolute()
    there = next((place for place in (folder, *folder.parents) if os.path.exists(place)), folder)
    return os.path.isdir(there) and os.access(there, os.W_OK | os.X_OK)


def _temporary() -> Path:
    """A folder that this user alone can write: what lies in it is run as code."""
    folder = Path(tempfile.gettempdir()) / f"gran-bench-cache-{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    found = folder.lstat()
    if stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid() and not found.st_mode & 0o077:
        return folder
    return Path(tempfile.mkdtemp(prefix=f"{folder.name}-"))


# When the package is imported, which is before any module of it defines a kernel.
provide_cache_folders()

"""A frame of the contact network and its adjoint, compiled and cached on disk; the interpreter lock is released."""

from __future__ import annotations

import hashlib
from pathlib import Path

from numba import njit

from gran_bench.dem import walls
from gran_bench.dem.fast import wall_list
from gran_bench.surrogate.contact import constants
from gran_bench.surrogate.contact.kernels import adjoint as contact_adjoint
from gran_bench.surrogate.contact.kernels import block as contact_block
from gran_bench.surrogate.contact.kernels import iterations as contact_iterations
from gran_bench.surrogate.contact.kernels import kinematics as contact_kinematics
from gran_bench.surrogate.contact.kernels.adjoint import iterate_adjoint
from gran_bench.surrogate.contact.kernels.iterations import iterate


def _keyed_entries(sources: str):
    """The two entries, cached on disk under the digest of everything that they are compiled from.

    Numba keys its cache by the file of the function alone, and a change of another file would go unnoticed. The
    variables of a closure are part of the key.
    """

    @njit(cache=True, nogil=True, error_model="numpy")
    def forward(*arguments):  # pragma: no cover - jitted
        sources  # noqa: B018 (the key)
        iterate(*arguments)

    @njit(cache=True, nogil=True, error_model="numpy")
    def adjoint(*arguments):  # pragma: no cover - jitted
        sources  # noqa: B018 (the key)
        iterate_adjoint(*arguments)

    return forward, adjoint


def digest_of_sources() -> str:
    """Of the files that the entries are compiled from, as they are on disk now."""
    others = (contact_iterations, contact_adjoint, contact_kinematics, contact_block, constants, wall_list, walls)
    files = (__file__, *(module.__file__ for module in others))
    sizes = repr(constants.FUSED_SIZES).encode()
    return hashlib.sha256(b"".join((sizes, *(Path(file).read_bytes() for file in files)))).hexdigest()


frame_forward, frame_adjoint = _keyed_entries(digest_of_sources())

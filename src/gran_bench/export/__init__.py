"""Trajectories in the formats of other programs: ParaView and VTK, OVITO, NumPy."""

from gran_bench.export.source import Exported, ExportError, exported_case, exported_rollout
from gran_bench.export.vtkhdf import write_vtkhdf
from gran_bench.export.xyz import write_npz, write_xyz

__all__ = [
    "ExportError",
    "Exported",
    "exported_case",
    "exported_rollout",
    "write_npz",
    "write_vtkhdf",
    "write_xyz",
]

"""Trajectories in the formats of other programs: ParaView and VTK, OVITO, NumPy."""

from gran_bench.export.formats import write_npz, write_vtkhdf, write_xyz
from gran_bench.export.source import Exported, ExportError, exported_case, exported_rollout

__all__ = ["ExportError", "Exported", "exported_case", "exported_rollout", "write_npz", "write_vtkhdf", "write_xyz"]

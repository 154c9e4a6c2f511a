"""Trajectories in the formats of other programs: ParaView and VTK, OVITO, NumPy."""

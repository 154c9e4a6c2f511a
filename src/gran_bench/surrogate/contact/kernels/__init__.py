"""Compiled iterations of the contact network, forward and adjoint."""

"""Verification of the DEM: experiments with known answers, and theory that shares no code with the solver."""

from gran_bench.verification import bouncing, chung_ooi, cluster, contact_memory, convergence, energy, impacts, rolling
from gran_bench.verification.case import Case, Check, Outcome, run_case

CASES = (
    *(*impacts.CASES, *contact_memory.CASES, *chung_ooi.CASES, *bouncing.CASES, *rolling.CASES),
    *(*convergence.CASES, *cluster.CASES, *energy.CASES),
)

__all__ = ["CASES", "Case", "Check", "Outcome", "run_case"]

"""Verification of the DEM: experiments with known answers, and theory that shares no code with the solver."""

from gran_bench.verification.case import Case, Check, Findings, Outcome
from gran_bench.verification.suite import CASES, run_case

__all__ = ["CASES", "Case", "Check", "Findings", "Outcome", "run_case"]

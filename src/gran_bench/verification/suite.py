"""All cases in one list, and running them: none skipped, none hidden."""

from __future__ import annotations

import time

from gran_bench.verification import (
    bounce,
    chung_ooi,
    conservation,
    convergence,
    drum_ball,
    engines,
    head_on,
    invariance,
    oblique,
    rolling_ball,
    stack,
    tangential_history,
)
from gran_bench.verification.case import Case, Findings, Outcome

CASES: tuple[Case, ...] = (
    *head_on.CASES,
    *oblique.CASES,
    *tangential_history.CASES,
    *chung_ooi.CASES,
    *bounce.CASES,
    *stack.CASES,
    *rolling_ball.CASES,
    *drum_ball.CASES,
    *conservation.CASES,
    *convergence.CASES,
    *invariance.CASES,
    *engines.CASES,
)


def run_case(case: Case) -> Outcome:
    """Runs a case; an error that stops it is a failure with its words, not a case that is missing."""
    started = time.perf_counter()
    try:
        findings, failure = case.run(), None
    except Exception as error:
        findings, failure = Findings(()), f"{type(error).__name__}: {error}"
    return Outcome(case, findings, time.perf_counter() - started, failure)

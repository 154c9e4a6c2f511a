"""The list of stress cases, read strictly: an unknown key, kind, parameter, quantity or unit is an error.

A list is a YAML file of the form

    - name: overlap at the start      # of the case, once in the list
      kind: start_overlap             # one of `perform.EXPERIMENTS`
      short: true                     # whether the short list has it too; false where it is left out
      with: {overlap: 0.1}            # parameters of the experiment
      expect:
        met: [{quantity: energy_released, at_most: 1.0, unit: of the stored}]

where ``expect`` has one of ``met`` and ``flagged``, with bounds, or ``error``, with the name of an exception; ``says``
beside it lists words that the error, or the flags, must hold. ``models: [contact]`` keeps a case to models of that
name.
"""

import inspect
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from importlib.resources import files
from pathlib import Path
from typing import Any

import yaml

from gran_bench.config.rules import ConfigError, checked_value
from gran_bench.stress.expectation import Bound, Expectation, Experiment
from gran_bench.stress.perform import EXPERIMENTS

SHIPPED_LISTS = ("dem", "surrogate")
KEYS = {"name": str, "kind": str, "expect": dict, "short": bool, "with": dict, "models": list[str]}
EXPECT = {"met": list[dict], "flagged": list[dict], "error": str, "says": list[str]}
BOUND = {"quantity": str, "unit": str, "at_most": float, "at_least": float}


@dataclass(frozen=True)
class StressCase:
    """One row of a list, with the keys that it has there (``with`` as parameters), and the list as its part."""

    name: str
    kind: str
    expectation: Expectation
    parameters: dict[str, Any] = field(default_factory=dict)
    short: bool = False
    models: Sequence[str] = ()
    part: str = ""


def shipped_cases() -> list[StressCase]:
    """All cases of the lists that ship with the package."""
    folder = files("gran_bench.stress") / "lists"
    texts = {part: (folder / f"{part}.yaml").read_text("utf-8") for part in SHIPPED_LISTS}
    return [case for part, text in texts.items() for case in read_cases(text, f"{part}.yaml", part)]


def cases_of_file(path: Path) -> list[StressCase]:
    """The cases of a file; a `ConfigError` where it cannot be read, as in `read_cases`."""
    try:
        text = path.read_text("utf-8")
    except OSError as error:
        raise ConfigError(f"case_list={path} cannot be read ({error.strerror}); give a YAML file of cases") from error
    return read_cases(text, str(path), path.stem)


def read_cases(text: str, source: str, part: str) -> list[StressCase]:
    """The cases that YAML text describes; a `ConfigError` that names source, case, what is wrong and what is right."""
    try:
        rows = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise ConfigError(f"{source} is no YAML ({' '.join(str(error).split())}); mend it") from error
    _require(isinstance(rows, list) and bool(rows), f"{source} is no list of cases; write '- name: …' for each")
    cases = [_case(row, f"{source}, case {number}", part) for number, row in enumerate(rows, 1)]
    for name, count in Counter(case.name for case in cases).items():
        _require(count == 1, f"{source}: the name {name!r} stands for {count} cases; change one")
    return cases


def near_match(word: str, known: Collection[str], otherwise: str) -> str:
    """The remedy for an unknown word: the known one that is meant, or other words."""
    near = get_close_matches(word, sorted(known), 1)
    return f"did you mean {near[0]}?" if near else otherwise


def _case(row: Any, place: str, part: str) -> StressCase:
    row = _section(row, place, "key", KEYS, ("name", "kind", "expect"))
    place = f"{place} ({row['name']})"
    experiment = _known(row["kind"], EXPERIMENTS, place, "kind")
    hints = {name: parameter.annotation for name, parameter in experiment.parameters.items()}
    needed = [name for name, one in experiment.parameters.items() if one.default is inspect.Parameter.empty]
    given = _section(row.get("with", {}), place, "parameter", hints, needed, "with.")
    words = f"{place}: kind={row['kind']} has no model, so models={row.get('models')} is idle; leave it out"
    _require(experiment.of_model or not row.get("models"), words)
    expectation = _expectation(row["expect"], place, experiment)
    others = {name: row[name] for name in ("name", "kind", "short", "models") if name in row}
    return StressCase(**others, expectation=expectation, parameters=given, part=part)


def _expectation(values: Any, place: str, experiment: Experiment) -> Expectation:
    values = _section(values, place, "key of expect", EXPECT, (), "expect.")
    forms, says = [form for form in ("met", "flagged", "error") if form in values], tuple(values.get("says", ()))
    words = f"{place}: expect has {' and '.join(forms) or 'nothing'}; give one of met, flagged, error"
    _require(len(forms) == 1, words)
    if forms == ["error"]:
        words = f"{place}: expect.error={values['error']} without expect.says; write what its message must hold"
        _require(bool(says), words)
        return Expectation("error", error=values["error"], says=says)
    rows = values[forms[0]]
    _require(bool(rows), f"{place}: expect.{forms[0]} has no bounds; give at least one")
    return Expectation(forms[0], tuple(_bound(row, place, experiment) for row in rows), says=says)


def _bound(row: Any, place: str, experiment: Experiment) -> Bound:
    bound = Bound(**_section(row, place, "key of a bound", BOUND, ("quantity", "unit")))
    unit = _known(bound.quantity, experiment.measures, place, "quantity")
    words = f"{place}: {bound.quantity} is measured in {unit!r}, not in {bound.unit!r}; change the bound"
    _require(bound.unit == unit, words)
    limited = bound.at_most is not None or bound.at_least is not None
    _require(limited, f"{place}: the bound of {bound.quantity} has no limit; give at_most or at_least")
    return bound


def _section(
    values: Any, place: str, what: str, hints: Mapping[str, Any], needed: Collection[str], path: str = ""
) -> dict[str, Any]:
    """The values of a mapping: each key known and of its type, none missing that is needed."""
    _require(isinstance(values, Mapping), f"{place}: {path}{values!r} is no mapping; write {{key: value}}")
    for key in values:
        _known(key, hints, place, what)
    for key in needed:
        _require(key in values, f"{place} needs {path}{key}; give it")
    return {key: checked_value(hints[key], None, value, f"{place}: {path}{key}") for key, value in values.items()}


def _known(word: Any, legal: Mapping[str, Any], place: str, what: str) -> Any:
    remedy = near_match(str(word), legal, f"choose from {', '.join(sorted(legal))}")
    _require(word in legal, f"{place}: {what} {word!r} is unknown; {remedy}")
    return legal[word]


def _require(holds: bool, message: str) -> None:
    if not holds:
        raise ConfigError(message)

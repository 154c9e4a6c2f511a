"""The list of stress cases, read strictly: an unknown key, kind, parameter, quantity or unit is an error.

A list is a YAML file of the form

    - name: overlap at the start      # of the case, once in the list
      kind: start_overlap             # one of `registry.EXPERIMENTS`
      short: true                     # whether the short list has it too; false where it is left out
      with: {overlap: 0.1}            # parameters of the experiment
      expect:
        met: [{quantity: energy_released, at_most: 1.0, unit: of the stored}]

where ``expect`` has one of ``met`` and ``flagged``, with bounds, or ``error``, with the name of an exception; ``says``
beside it lists words that the error, or the flags, must hold. ``models: [contact]`` keeps a case to models of that
name. ``known: why`` marks a failure that is not mended yet; it goes on failing.
"""

from __future__ import annotations

import inspect
import types
from collections.abc import Mapping
from dataclasses import dataclass, field
from difflib import get_close_matches
from importlib.resources import files
from pathlib import Path
from typing import Any, get_args, get_origin, get_type_hints

import yaml

from gran_bench.config.rules import ConfigError
from gran_bench.stress.expectation import Bound, Expectation
from gran_bench.stress.experiment import Experiment

SHIPPED_LISTS = ("dem", "surrogate")
_KEYS = {"name", "kind", "short", "models", "with", "expect", "known"}


@dataclass(frozen=True)
class StressCase:
    """One row of the list.

    Attributes:
        name: of the case.
        kind: of the experiment.
        expectation: written before it runs.
        parameters: of the experiment.
        short: whether the short list has it.
        models: that it is for; empty for every one.
        known: what is known of a failure that is not mended yet; it still fails.
        part: the list that it stands in.
    """

    name: str
    kind: str
    expectation: Expectation
    parameters: Mapping[str, Any] = field(default_factory=dict)
    short: bool = False
    models: tuple[str, ...] = ()
    known: str = ""
    part: str = ""


def shipped_cases(experiments: Mapping[str, Experiment]) -> list[StressCase]:
    """All cases of the lists that ship with the package."""
    folder = files("gran_bench.stress") / "lists"
    cases = []
    for part in SHIPPED_LISTS:
        cases += read_cases((folder / f"{part}.yaml").read_text("utf-8"), f"{part}.yaml", experiments, part)
    return _named_once(cases, "the shipped lists")


def cases_of_file(path: Path, experiments: Mapping[str, Experiment]) -> list[StressCase]:
    """The cases of a file.

    Raises:
        ConfigError: no such file, or a list that cannot be.
    """
    try:
        text = path.read_text("utf-8")
    except OSError as error:
        raise ConfigError(f"case_list={path} cannot be read ({error.strerror}); give a YAML file of cases") from error
    return _named_once(read_cases(text, str(path), experiments, path.stem), str(path))


def read_cases(text: str, source: str, experiments: Mapping[str, Experiment], part: str) -> list[StressCase]:
    """The cases that YAML text describes.

    Raises:
        ConfigError: names the source, the case, what is wrong and what is right.
    """
    try:
        rows = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise ConfigError(f"{source} is no YAML ({' '.join(str(error).split())}); mend it") from error
    _require(isinstance(rows, list) and bool(rows), f"{source} is no list of cases; write '- name: …' for each")
    return [_case(row, f"{source}, case {number}", experiments, part) for number, row in enumerate(rows, 1)]


def _case(row: Any, place: str, experiments: Mapping[str, Experiment], part: str) -> StressCase:
    _require(isinstance(row, Mapping), f"{place} is {row!r}; write keys and values")
    _known(row, _KEYS, place, "key")
    for key in ("name", "kind", "expect"):
        _require(key in row, f"{place} has no {key}; give it one")
    _require(isinstance(row["name"], str) and bool(row["name"].strip()), f"{place}: name={row['name']!r} is no word")
    place = f"{place} ({row['name']})"
    _known([row["kind"]], set(experiments), place, "kind")
    experiment = experiments[row["kind"]]
    given = row.get("with", {})
    _require(
        isinstance(given, Mapping), f"{place}: with={given!r} is no list of parameters; write with: {{key: value}}"
    )
    _known(given, set(experiment.parameters), place, "parameter")
    hints = get_type_hints(experiment.run)
    for name, parameter in experiment.parameters.items():
        if name in given:
            _require(_fits(given[name], hints[name]), f"{place}: with.{name}={given[name]!r} is no {hints[name]}")
        else:
            _require(parameter.default is not inspect.Parameter.empty, f"{place} needs with.{name}; give it")
    short, models, known = row.get("short", False), row.get("models", []), row.get("known", "")
    _require(type(short) is bool, f"{place}: short={short!r} is neither true nor false")
    _require(isinstance(models, list), f"{place}: models={models!r} is no list; write [{models}]")
    _require(experiment.of_model or not models, f"{place}: kind={row['kind']} has no model, so models={models} is idle")
    _require(isinstance(known, str), f"{place}: known={known!r} is no text")
    return StressCase(
        row["name"], row["kind"], _expectation(row["expect"], place, experiment), dict(given), short, tuple(models),
        known, part,
    )  # fmt: skip


def _expectation(values: Any, place: str, experiment: Experiment) -> Expectation:
    _require(isinstance(values, Mapping), f"{place}: expect={values!r} is no expectation; give met, flagged or error")
    _known(values, {"met", "flagged", "error", "says"}, place, "key of expect")
    forms = [form for form in ("met", "flagged", "error") if form in values]
    _require(
        len(forms) == 1, f"{place}: expect has {' and '.join(forms) or 'nothing'}; give one of met, flagged, error"
    )
    says = values.get("says", [])
    right = isinstance(says, list) and all(isinstance(word, str) and word for word in says)
    _require(right, f"{place}: expect.says={says!r} is no list of words")
    if forms == ["error"]:
        name = values["error"]
        _require(isinstance(name, str) and name.isidentifier(), f"{place}: expect.error={name!r} is no class of errors")
        _require(bool(says), f"{place}: expect.error={name} without expect.says; write what its message must hold")
        return Expectation("error", error=name, says=tuple(says))
    rows = values[forms[0]]
    _require(isinstance(rows, list) and bool(rows), f"{place}: expect.{forms[0]} has no bounds; give at least one")
    bounds = tuple(_bound(row, place, experiment) for row in rows)
    return Expectation(forms[0], bounds, says=tuple(says))


def _bound(row: Any, place: str, experiment: Experiment) -> Bound:
    _require(isinstance(row, Mapping), f"{place}: {row!r} is no bound; write {{quantity: …, at_most: …, unit: …}}")
    _known(row, {"quantity", "unit", "at_most", "at_least"}, place, "key of a bound")
    for key in ("quantity", "unit"):
        _require(key in row, f"{place}: a bound has no {key}; give it one")
    name = row["quantity"]
    _known([name], set(experiment.measures), place, "quantity")
    right = experiment.measures[name]
    _require(
        row["unit"] == right, f"{place}: {name} is measured in {right!r}, not in {row['unit']!r}; change the bound"
    )
    limits = {key: row[key] for key in ("at_most", "at_least") if key in row}
    _require(bool(limits), f"{place}: the bound of {name} has no limit; give at_most or at_least")
    for key, limit in limits.items():
        _require(_fits(limit, float), f"{place}: {key}={limit!r} of {name} is no number")
    return Bound(name, right, **{key: float(limit) for key, limit in limits.items()})


def _named_once(cases: list[StressCase], source: str) -> list[StressCase]:
    names = [case.name for case in cases]
    twice = sorted({name for name in names if names.count(name) > 1})
    _require(not twice, f"{source}: the name {twice and twice[0]!r} stands for two cases; change one")
    return cases


def _known(keys: Any, legal: set[str], place: str, what: str) -> None:
    for key in keys:
        near = get_close_matches(str(key), sorted(legal), 1)
        remedy = f"did you mean {near[0]}?" if near else f"choose from {', '.join(sorted(legal))}"
        _require(key in legal, f"{place}: {what} {key!r} is unknown; {remedy}")


def _fits(value: Any, hint: Any) -> bool:
    """Whether a plain value is of an annotated type; a whole number is a number too, true and false are none."""
    if isinstance(hint, types.UnionType):
        return any(_fits(value, member) for member in get_args(hint))
    if get_origin(hint) is list:
        return isinstance(value, list) and all(_fits(entry, get_args(hint)[0]) for entry in value)
    if get_origin(hint) is dict:
        return isinstance(value, Mapping) and all(isinstance(key, str) for key in value)
    if hint is float:
        return isinstance(value, int | float) and not isinstance(value, bool)
    return type(value) is hint


def _require(holds: bool, message: str) -> None:
    if not holds:
        raise ConfigError(message)

"""Advice works when it is followed, what a help lists is there, and a command with nothing to do is refused."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import get_type_hints

import pytest

import gran_bench.conf
from gran_bench.compose import Source, checked_config, compose, described_jobs
from gran_bench.config import (
    BenchmarkConfig,
    CalibrateConfig,
    CoarseGrainingConfig,
    EvaluateConfig,
    GenerateConfig,
    StressConfig,
    TrackingConfig,
    TrainConfig,
    UiConfig,
)
from gran_bench.config.override_errors import explain
from gran_bench.config.reading import section_names
from gran_bench.config.rules import ConfigError
from gran_bench.surrogate.checkpoint import CHECKPOINT, MODEL, CheckpointError, load_card, write_tensors
from gran_bench.tracking import ui_command

CONF = Path(gran_bench.conf.__path__[0])
COMMANDS = {
    "train": TrainConfig,
    "generate": GenerateConfig,
    "evaluate": EvaluateConfig,
    "benchmark": BenchmarkConfig,
    "coarse_graining": CoarseGrainingConfig,
    "calibrate": CalibrateConfig,
    "stress": StressConfig,
    "ui": UiConfig,
}
INNER = {"mixture"}  # groups of train that fill a section of another group, trainer.mixture
# Choices that go with another one, as the help says.
PARTNERS = ([], ["model=ccnn"], ["model=radial"], ["judge=quick"], ["dataset=small"])


def refusal(command: str, *overrides: str) -> str | None:
    """Why a command refuses its overrides, in one line; None where it takes them."""
    try:
        checked_config(compose(command, list(overrides)), COMMANDS[command])
    except Exception as error:
        said = explain(error, COMMANDS[command])
        if said is None or "\n" in said:
            raise
        return said
    return None


# ---- help ----------------------------------------------------------------------------------------------------


def help_of(command: str) -> str:
    done = subprocess.run(
        [sys.executable, "-m", f"gran_bench.{command}", "--help"], capture_output=True, text=True, check=True
    )
    return done.stdout


@pytest.mark.parametrize("command", COMMANDS)
def test_the_help_lists_the_groups_of_its_own_command_and_each_choice_works(command):
    listed = dict(re.findall(r"^ *([+\w/]+): (\w+(?:, \w+)*)$", help_of(command), re.MULTILINE))
    groups = [name for name in section_names(COMMANDS[command]) if (CONF / name).is_dir()]
    if command != "ui":  # where it records has one choice that has a UI
        assert set(groups) <= set(listed)
    for group, choices in listed.items():
        if group == "hydra/launcher":
            assert set(choices.split(", ")) <= {"basic", *(path.stem for path in (CONF / group).glob("*.yaml"))}
            continue
        assert group in INNER or group.lstrip("+") in get_type_hints(COMMANDS[command])
        assert set(choices.split(", ")) <= {path.stem for path in (CONF / group.lstrip("+")).glob("*.yaml")}
        for choice in choices.split(", ") if command != "train" else ():  # test_config.py composes those of train
            refusals = (refusal(command, f"{group}={choice}", *partner) for partner in PARTNERS)
            assert None in refusals, (group, choice)


@pytest.mark.parametrize("command", COMMANDS)
def test_what_the_help_gives_as_an_example_is_taken(command):
    text = help_of(command)
    for line in re.findall(rf"^ +python -m gran_bench\.{command} ?(.*)$", text, re.MULTILINE):
        words = line.partition("#")[0].replace("'", "").split()
        if "--cfg" in words or any("NAME" in word or "..." in word or word.startswith("[") for word in words):
            continue
        described_jobs(Source(command), [word for word in words if word != "-m"], multirun="-m" in words)


def test_no_key_has_the_name_of_a_group_of_choices_which_hydra_would_take_it_for():
    groups = {path.name for path in CONF.iterdir() if path.is_dir()}
    for command, schema in COMMANDS.items():
        keys = set(get_type_hints(schema)) - set(section_names(schema))
        assert keys & groups <= ({"experiment"} if command == "train" else set()), command


@pytest.mark.parametrize("words", [("verify", "--list"), ("train", "--help")])
def test_a_reader_who_leaves_early_ends_a_command_in_silence(words):
    program, *arguments = words
    process = subprocess.Popen(
        [sys.executable, "-m", f"gran_bench.{program}", *arguments],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    process.stdout.close()
    assert process.stderr.read() == ""
    process.stderr.close()
    assert process.wait(60) == 128 + 13


# ---- advice --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("group", sorted({path.parent.name for path in CONF.glob("*/*.yaml")}))
def test_a_group_that_a_command_does_not_have_is_answered_with_those_that_it_has(command, group):
    if group in section_names(COMMANDS[command]) or (command == "train" and group in INNER):
        return
    choice = sorted((CONF / group).glob("*.yaml"))[0].stem
    said = refusal(command, f"{group}={choice}")
    if f"write +{group}={choice}" in said:
        assert refusal(command, f"+{group}={choice}") is None
        return
    assert f"this command has no group {group}" in said
    if listed := re.search(r"its groups are (.*)", said):
        for own in listed[1].split(", "):
            assert "no group" not in (refusal(command, f"{own}=nothing") or "")
    else:
        assert "its keys are" in said


def test_a_recipe_for_another_command_is_told_apart():
    said = refusal("evaluate", "+experiment=smoke")
    assert said.startswith("experiment/smoke changes scene, which this command does not have; its groups are dem, ")


@pytest.mark.parametrize(
    ("typed", "section"),
    [
        ("scene.container.lifters=3", "scene.container"),
        ("scene.filling.sizes.zzz=1", "scene.filling.sizes"),
        ("+scene.filling.sizes.zzz=1", "scene.filling.sizes"),
        ("+boundary.qqq=1", "boundary"),
        ("scene.zzz.deep.down=1", "scene"),
        ("qqqq=1", ""),
    ],
)
def test_an_unknown_key_is_answered_with_the_keys_of_its_own_section_and_each_of_them_is_one(typed, section):
    said = refusal("train", typed)
    place = f"the keys of {section}" if section else "the sections and keys"
    listed = re.search(rf"no such key; {re.escape(place)} are (.*)", said)
    assert listed, said
    for key in listed[1].split(", "):
        told = refusal("train", f"{section}.{key}=zzz".lstrip("."))
        assert told is None or "no such key; the " not in told, told


@pytest.mark.parametrize(
    "typed",
    ["sede=1", "model.widht=3", "scene.restitution=0.5", "scene.wall_material.friction=0.1", "experiment=smoke",
     "+seed=1", "model=cnn", "scene=", "judge=quik", "+experiment=smok", "dataset.training_speed_rpm=[20.0]"],
)  # fmt: skip
def test_following_the_advice_leads_to_a_command_that_is_taken(typed):
    """At most three times, because one piece may lead to another; what is refused in the end is no name any more."""
    plus, value = "+" if typed.startswith("+") else "", typed.partition("=")[2]
    for _ in range(3):
        said = refusal("train", typed)
        if said is None or not re.search(r"no such|write \+|there already|belongs to", said):
            return
        if found := re.search(r"write (\+\S+=\S+)|write (\S+)=VALUE", said):
            typed = found[1] or f"{found[2]}={value}"
        elif found := re.search(r"^\+?(\w+)=\S*: no such choice; (?:did you mean (\w+)|choose (\w+))", said):
            typed = f"{plus}{found[1]}={found[2] or found[3]}"
        elif found := re.search(r"did you mean ([\w.]+)\?", said):
            typed = f"{found[1]}={value}"
        elif found := re.search(r"it belongs to ([\w.]+)=(\w+)", said):
            assert "belongs to" not in (refusal("train", f"{found[1]}={found[2]}", typed) or "")
            return
        else:
            pytest.fail(f"{typed}: {said}")
    pytest.fail(f"{typed}: {said}")


def test_a_file_that_is_no_model_is_answered_with_the_model_beside_it(tmp_path):
    state = tmp_path / CHECKPOINT
    write_tensors(state, {"step": 3})
    with pytest.raises(CheckpointError, match=f"leaves {MODEL} beside it"):
        load_card(state)
    write_tensors(tmp_path / MODEL, {"weights": {}, "model": {}, "boundary": {}, "scene": {}, "origin": {}})
    for wrong in (state, tmp_path):
        with pytest.raises(CheckpointError) as caught:
            load_card(wrong)
        advised = re.search(r"give (\S+)$", str(caught.value))[1]
        assert load_card(Path(advised))[1] == {}


def test_the_ui_is_named_as_it_can_be_opened(tmp_path, monkeypatch):
    clone = Path(gran_bench.__file__).resolve().parents[2]
    monkeypatch.chdir(clone)
    assert ui_command(TrackingConfig()) == "make ui"
    assert ui_command(TrackingConfig(), 5001) == "make ui PORT=5001"
    elsewhere = ui_command(TrackingConfig(root="my results?x=1", experiment="a"))
    monkeypatch.chdir(tmp_path)
    assert ui_command(TrackingConfig()) == "python -m gran_bench.ui"
    for command, root in ((elsewhere, "my results?x=1"), (ui_command(TrackingConfig(root="other"), 7), "other")):
        words = shlex.split(command)
        assert words[:3] == ["python", "-m", "gran_bench.ui"]
        config = checked_config(compose("ui", words[3:]), UiConfig)
        assert config.tracking.root == root


# ---- nothing to do -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("command", "overrides", "named"),
    [
        ("train", ["+experiment=smoke", "seed=range(0,0)"], "seed=range(0,0)"),
        ("train", ["+experiment=smoke", "seed=1,2", "threads=range(3,1)"], "threads=range(3,1)"),
        ("benchmark", ["seed=range(0,0)"], "seed=range(0,0)"),
    ],
)
def test_a_sweep_without_a_job_is_refused_by_the_axis_that_is_empty(command, overrides, named):
    with pytest.raises(ConfigError, match=re.escape(f"{named} has no value, so there is no job to run")):
        described_jobs(Source(command), overrides, multirun=True)


def test_a_data_set_without_a_speed_is_refused_before_any_work_by_all_who_make_it():
    for command in ("train", "generate"):
        assert "leaves nothing to train on; give at least one speed" in refusal(
            command, "dataset.training_speeds_rpm=[]", "scene=drum_small", "dataset.holdout_speeds_rpm=[30.0]"
        )
    assert refusal("generate", "scene=packing", "dataset.training_speeds_rpm=[]") is None  # keeps its own motion

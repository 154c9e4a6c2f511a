"""Say in one line what Hydra, OmegaConf or a full disk says in many, and name the nearest right word."""

import errno
import re
from difflib import get_close_matches
from importlib import resources

from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from gran_bench.config.reading import CHOSEN, section_names, unknown_key
from gran_bench.config.rules import hints_of

CONF = "gran_bench.conf"
RECIPES = "experiment"  # the group that no command has chosen, so that one is added with +


def explain(error: Exception, schema: type) -> str | None:
    """One line for an error of this package, Hydra, OmegaConf, a YAML file or a full disk.

    None for any other, which is a bug and needs its traceback. The schema is for the nearest right key.
    """
    if isinstance(error, MissingConfigException) and error.options:
        group, _, choice = (error.missing_cfg_file or "").rpartition("/")
        guesses = get_close_matches(choice, error.options, n=1, cutoff=0.65)
        listed = ", ".join(error.options)
        meant = f"did you mean {guesses[0]}? ({listed})" if guesses else f"choose {' or '.join(error.options)}"
        return f"{'+' if group == RECIPES else ''}{group}={choice}: no such choice; {meant}"
    if isinstance(error, OverrideParseException):
        return f"{error.override}: not KEY=VALUE as Hydra reads it; quote a value that has spaces or symbols"
    if isinstance(error, HydraException):
        return _composition(error, schema)
    if isinstance(error, OmegaConfBaseException):
        key = getattr(error, "full_key", None)
        return f"{key}: {_first_line(error)}" if key else _first_line(error)
    if isinstance(error, BrokenPipeError):
        return "nobody reads the output any more; what is finished is whole"
    if is_full_disk(error):
        where = f" {error.filename}" if error.filename else ""
        remedy = "free space, and the same command goes on from here: what is finished is whole"
        return f"the disk takes no more ({error.strerror}{where}); {remedy}"
    if isinstance(error, YAMLError) or type(error).__module__.startswith("gran_bench."):
        return " ".join(str(error).split())
    return None


def is_full_disk(error: Exception) -> bool:
    """Whether the system refused to write for want of space, quota or permitted file size."""
    return isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def _composition(error: HydraException, schema: type) -> str:
    message = str(error)
    if found := re.search(r"(?:In '([^']+)': )?Could not override '([^']+)'\. No match in the defaults list", message):
        within, group = found[1], found[2]  # the file that asks for it, if it was not typed
        typed, keys = (re.search(r"use \+(\S+)", message) or {1: group})[1], hints_of(schema)
        if group == RECIPES and RECIPES in keys:
            return f"{typed}: a recipe is added; write +{typed}"
        groups = [name for name in section_names(schema) if resources.files(CONF).joinpath(name).is_dir()]
        has = f"its groups are {', '.join(groups)}" if groups else f"its keys are {', '.join(keys)}"
        if within is not None:
            return f"{within} changes {group}, which this command does not have; {has}"
        return f"{typed}: this command has no group {group}; {has}"
    if found := re.search(r"Could not override '([^']+)'\.?\s+To append to your config use \+(\S+)=(.*)", message):
        key, value = found[1], found[3].strip()
        if key.startswith("hydra."):
            return f"{key}={value}: no such key; --cfg hydra shows those of Hydra"
        place, present = key.rpartition(".")[0], None
        if place in CHOSEN and hasattr(error, "without"):  # the section's class is a choice of the other overrides
            owner = CHOSEN[place].get(OmegaConf.select(error.without, f"{place}.{CHOSEN[place].chooser}"))
            present = owner and [f"{place}.{name}" for name in hints_of(owner.config)]
        return str(unknown_key(key, value, schema, present))
    if found := re.search(r"Could not append to config\. An item is already at '([^']+)'", message):
        return f"+{found[1]}: the key is there already; write {found[1]}=VALUE without +"
    if found := re.search(r"Ambiguous value for argument '([^']+)'", message):
        return f"{found[1]}: several values; add -m to run each, or write KEY=[A,B] for a list"
    return _first_line(error)


def _first_line(error: Exception) -> str:
    return next((line.strip() for line in str(error).splitlines() if line.strip()), type(error).__name__)

"""What a command is told: the schema of every key, strict reading, and what fits together."""

from gran_bench.config.commands import *
from gran_bench.config.emulator import SchedulesConfig
from gran_bench.config.schema import *
from gran_bench.config.trainer import MixtureConfig, TrainerConfig

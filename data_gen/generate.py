"""Make the cases of a data set: ``python data_gen/generate.py``, the same as ``python -m gran_bench.generate``."""

from gran_bench.config import GenerateConfig
from gran_bench.entry import run
from gran_bench.generate import task

if __name__ == "__main__":
    run(task, "generate", GenerateConfig)

"""Print the tables of the data card: ``python data_gen/card.py``, with the overrides of ``gran_bench.generate``."""

from gran_bench.config import GenerateConfig
from gran_bench.entry import run
from gran_bench.plots.data_card import print_data_card

if __name__ == "__main__":
    run(print_data_card, "generate", GenerateConfig)

"""The emulator: statistics of a drum's flow from the wall's speed up to now, without particles."""

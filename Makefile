# Each target builds .venv from requirements.lock when it is missing or old; `make train` alone is enough.
# PYTHON=python3.12 chooses another interpreter (3.11 or newer).

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
SELENIUM := $(BIN)/python -m pip install --quiet --disable-pip-version-check "selenium>=4.20"
READERS := $(BIN)/python -m pip install --quiet --disable-pip-version-check "vtk>=9.5" "ovito>=3.12"
CLUSTERS := $(BIN)/python -m pip install --quiet --disable-pip-version-check "submitit~=1.5" "ray~=2.60"
PORT ?= 5000

.PHONY: train data test test-slow lint ui browser-test verify bench bench-kernels stress clean

train: $(READY)
	$(BIN)/python -m gran_bench.train +experiment=holdout30rpm

data: $(READY)
	$(BIN)/python -m gran_bench.generate

test: lint
	$(BIN)/python -m pytest -n 2 --dist loadfile

lint: $(READY)
	$(BIN)/ruff check .

ui: $(READY)
	$(BIN)/python -m gran_bench.ui port=$(PORT)

# The browser's tests are among them where chromium and chromedriver are (Debian: chromium, chromium-driver).
test-slow: $(READY)
	@if command -v chromium chromedriver > /dev/null; then $(SELENIUM); \
	else echo "no chromium and chromedriver on the PATH: the tests of the browser are skipped"; fi
	@$(READERS) || echo "vtk and ovito were not installed: the tests that read exports back are skipped"
	@$(CLUSTERS) || echo "submitit and ray were not installed: the tests of Slurm and Ray are skipped"
	$(BIN)/python -m pytest tests/test_export.py
	$(BIN)/python -m pytest -m "slow or browser" -n 2 --dist loadfile

browser-test: $(READY)
	@$(SELENIUM)
	$(BIN)/python -m pytest -m browser tests/browser

verify: $(READY)
	$(BIN)/python -m data_gen.verify

bench: $(READY)
	$(BIN)/python -m gran_bench.benchmark

# benchmarks/dem_vs_lammps.py needs LAMMPS; it says how.
bench-kernels: $(READY)
	$(BIN)/python benchmarks/dem_frames.py
	$(BIN)/python benchmarks/dem_skips.py
	$(BIN)/python benchmarks/dem_scaling.py --counts 300 1000 3000 10000 30000
	$(BIN)/python benchmarks/contact_network.py
	$(BIN)/python benchmarks/cconv.py

stress: $(READY)
	$(BIN)/python -m gran_bench.stress

clean:
	rm -rf $(VENV) build dist .pytest_cache .ruff_cache

# The mark is written last, so that an interrupted installation is taken up again.
$(READY): requirements.lock pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "Python 3.11 or newer is needed; choose one with make PYTHON=python3.12" >&2; exit 1; }
	@test -x $(BIN)/python || { rm -rf $(VENV); $(PYTHON) -m venv $(VENV); }
	@echo "Installing the packages of requirements.lock into $(VENV) (a minute or two)"
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check -r requirements.lock
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --editable .
	@echo "Checking the installation by an experiment of two spheres, which also compiles the DEM's kernels"
	@$(BIN)/python -m gran_bench.verify --case chung-ooi-1 > /dev/null
	@touch $@

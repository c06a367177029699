# make demo    simulated people: fit two methods, print the table, save demo/futures.png and demo/report.html
# make test    lint, types, tests, and some of these once more as on another processor
# make quick   lint, types, and the tests that are not slow
# make studies   the longer notebooks, on a small share of their work
# make fuzz    hostile and random examples, new ones each time, for SECONDS=600; SEED=n tries those of a run again
# make coverage   the tests, and which lines none of them runs
# make gpu     on a machine with a GPU: its tests, start-up, and the speed of training steps; at most 10 minutes
# make bench   the benchmarks, beside their targets and the last release; as JSON in bench.json; on a GPU with DEVICE=cuda,
#              which also stores them in benchmarks/gpu-history.json and docs/results/speed.md
# make notebooks   runs the notebooks and stores them with what they show
# make docs    the site, in docs/_build/html
# make dist    sdist, and from it the wheel, in dist; installed and started where there is nothing else
# Each makes the environment in .venv when it is missing or out of date. ENV=/usr uses the one of /usr/bin/python3 as it
# is, with nothing installed; it needs the packages of the extra dev.

PYTHON := python3
ENV :=
BIN := $(or $(ENV),.venv)/bin

# One thread: the models are small, and on cores that others use too, two threads wait for each other many times longer.
export OMP_NUM_THREADS := 1

# Tests start a hundred processes, each of which would compile the library anew.
unexport PYTHONDONTWRITEBYTECODE

# Numerical tests, for the second run: other instructions round otherwise.
NUMERICAL := distributions/test_distributions.py networks/test_networks.py networks/test_graphconv.py program/test_oracle.py \
	program/test_model.py models/motion/test_trajectories.py motion/test_control.py motion/test_forecasts.py \
	inference/bounds/test_bounds.py inference/bounds/test_particles.py inference/evaluation/test_metrics.py

# Torch comes first, or another build may come along. Its build for CUDA brings gigabytes that only a GPU uses, so without
# one the build for the CPU is taken where pip finds it: on its own index or on TORCH_INDEX.
TORCH_INDEX :=
TORCH := torch==2.13.0
pip_torch = $(1) -m pip install -q -c constraints.txt $(if $(TORCH_INDEX),--extra-index-url $(TORCH_INDEX))
torch = @test `uname` != Linux || command -v nvidia-smi > /dev/null || $(pip_torch) $(TORCH)+cpu 2> /dev/null || \
	echo "pip finds no torch for the CPU alone and takes the one for CUDA; see TORCH_INDEX in CONTRIBUTING.md"; \
	$(pip_torch) $(TORCH)

.PHONY: venv demo lint quick test studies fuzz coverage gpu bench notebooks docs dist clean

venv: $(if $(ENV),,.venv/installed)

.venv/installed: pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "Python 3.11 or newer is needed; choose one with: make PYTHON=python3.12"; exit 1; }
	@$(PYTHON) -c 'import venv, ensurepip' || \
		{ echo "Python lacks venv; on Debian and Ubuntu: apt install python3-venv"; exit 1; }
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(call torch,$(BIN)/python)
	$(BIN)/python -m pip install -q -c constraints.txt -e ".[dev]"
	touch $@

demo: venv
	$(BIN)/python -m benchmarks.studies.demo

quick: lint
	$(BIN)/pytest -n 2 -m "not slow"

lint: venv
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy -p dvae

test: venv
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy -p dvae & types=$$!; $(BIN)/pytest -n 2 --dist worksteal && wait $$types
	ATEN_CPU_CAPABILITY=default $(BIN)/pytest -n 2 --dist worksteal -m "not slow" -k "not beside_its_result" $(addprefix tests/,$(NUMERICAL))

studies: venv
	$(BIN)/pytest -n 2 --dist worksteal tests/studies/long

SECONDS := 600
SEED := $(shell date +%s)

fuzz: venv
	DVAE_FUZZ_SECONDS=$(SECONDS) DVAE_FUZZ_SEED=$(SEED) $(BIN)/pytest tests/fuzz -s

coverage: venv
	$(BIN)/pytest -n 2 --cov --cov-report=term-missing:skip-covered --cov-fail-under=97

# Measurements follow failed tests too. An interrupt keeps the finished rows.
gpu: venv
	TRITON_DEFAULT_FP_FUSION=1 timeout -k 10 230 $(BIN)/python3 -m pytest -n 4 -m gpu --timeout 60; tests=$$?; \
	timeout -s INT -k 10 320 $(BIN)/python3 -m benchmarks.bench startup graphs peers speed --device cuda --keep && test $$tests = 0; \
	status=$$?; $(BIN)/python3 -m benchmarks.studies.cards && exit $$status

DEVICE := cpu

bench: venv
	$(BIN)/python3 -m benchmarks.bench --device $(DEVICE) $(if $(filter cuda,$(DEVICE)),--keep); status=$$?; \
	$(BIN)/python3 -m benchmarks.studies.cards && exit $$status

notebooks: venv
	$(BIN)/python -m benchmarks.studies.notebooks notebooks/*.ipynb

docs: venv
	$(BIN)/python -c 'import furo, myst_nb' 2>/dev/null || $(BIN)/python -m pip install -q -c constraints.txt -e ".[docs]"
	rm -rf docs/reference/_generated
	$(BIN)/sphinx-build -W --keep-going -q docs docs/_build/html
	@echo "docs/_build/html/index.html"

CLEAN := build/clean/bin

dist: venv
	rm -rf build dist
	$(BIN)/python -m build
	$(PYTHON) -m venv build/clean
	$(call torch,$(CLEAN)/python)
	$(CLEAN)/python -m pip install -q -c constraints.txt dist/*.whl
	cd build && clean/bin/dvae --help > /dev/null && clean/bin/dvae list > /dev/null
	cd build && clean/bin/python -c 'import dvae, dvae.models.family.srnn, dvae.inference.training.fit; print(dvae.__version__, dvae.__file__)'

clean:
	rm -rf .venv build dist *.egg-info demo runs docs/_build docs/reference/_generated docs/notebooks .pytest_cache .mypy_cache .ruff_cache .hypothesis

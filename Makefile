# make fly    fly the SITL pair over a laggy link, over UDP on this machine
# make test   the test suite (under 10 minutes)
# make check  what CI runs: format, lint, types, import contract
# make bench  what it costs, as ratios; compiled, too, where there is a C compiler
# make fuzz   fuzz one decoder: TARGET=autopilot SECONDS=60
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
FLIGHT ?= nominal
TARGET ?= autopilot
SECONDS ?= 60

.PHONY: setup fly test check check-long bench compiled fuzz format clean

setup: $(VENV)/ready

$(VENV)/ready: pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "make: $(PYTHON) is older than Python 3.11; say PYTHON=python3.12, for example" >&2; exit 2; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	@# a ground station for the tests; its own list of requirements holds a desktop that headless use leaves out
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt --no-deps MAVProxy
	@touch $@

fly: setup
	$(BIN)/sitl fly $(FLIGHT)

test: setup
	$(BIN)/pytest -m "not long and not realtime" -n auto --dist loadfile
	$(BIN)/pytest -m "realtime and not long"

check: setup
	$(BIN)/ruff format --check
	$(BIN)/ruff check
	$(BIN)/mypy
	$(BIN)/lint-imports

check-long: setup
	$(BIN)/pytest -m long

# the same package with its hot path compiled (setup.py), beside the one in $(VENV): PYTHONPATH=build/compiled .venv/bin/sitl fly
compiled: setup
	rm -rf build/compiled
	LAGPROOF_COMPILE=1 $(BIN)/pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation \
		--target build/compiled .

bench: setup
	$(BIN)/python -m tests.bench

fuzz: setup
	$(BIN)/python -m tests.fuzz $(TARGET) --seconds $(SECONDS)

format: setup
	$(BIN)/ruff format
	$(BIN)/ruff check --fix

clean:
	rm -rf $(VENV) build dist *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis

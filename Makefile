# Two commands do everything on a fresh machine: `make demo` and `make test`.
PYTHON ?= python3
SHELL  := bash
VENV   := .venv
BIN    := $(VENV)/bin
PIP     = $(BIN)/python -m pip --disable-pip-version-check
# A line a package as it is collected, drawn over itself on a terminal.
PIP_PROGRESS = if [ -t 2 ]; then sed -un 's/^Collecting \([^ ]*\).*/\r\x1b[K  \1/p;s/^Installing.*/\r\x1b[K  installing\n/p' | tr -d '\n' >&2; \
  echo >&2; else grep --line-buffered ^Installing >&2 || true; fi
BOARD  ?= auto
# Without bytecode on disk, each of the hundreds of commands that tests start would compile its modules again.
unexport PYTHONDONTWRITEBYTECODE
TEST_ARGS ?= -n 2 --dist loadfile
INPUTS ?= 10000000
FILES  ?= 100000
SEED   ?= 1

DEBIAN_PYTHON := python3-venv
DEBIAN_BOARD  := gcc libc6-dev make gcc-avr avr-libc binutils-avr simavr libsimavr-dev libelf-dev avrdude

# Prints, on standard error, which step of the set-up begins.
step = echo "seldinger: set-up, step $(1)" >&2

.PHONY: demo test quick long setup board-tools packages warm format-check lint types lock lock-check audit nojit bench prove prove-small prove-worlds live-study faults faults-ci fuzz fuzz-files proof chaos soak clean

demo: setup
	@$(BIN)/seldinger demo --board $(BOARD) $(DEMO_ARGS)

test: setup
	@$(BIN)/python -m pytest $(TEST_ARGS)

# What a change needs before it is committed: no test that takes long, or needs the AVR tool chain, recordings or a browser.
quick: setup
	@$(BIN)/python -m pytest $(TEST_ARGS) -m "not slow and not long and not avr and not data and not browser"

setup: packages board-tools $(VENV)/.warm

packages: $(VENV)/.ready

# Apt is used when root or when sudo asks for no password; else one line names what is missing.
define apt_install
if [ "$$(id -u)" = 0 ]; then APT=""; elif sudo -n true 2>/dev/null; then APT="sudo -n"; else APT=none; fi; \
if [ "$$APT" = none ] || ! command -v apt-get >/dev/null; then echo "seldinger: missing Debian packages: $(1)" >&2; false; \
else echo "seldinger: installing $(1)" >&2; \
  { $$APT apt-get update -qq && $$APT env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends $(1); } >build/apt.log 2>&1 \
  || { echo "seldinger: apt could not install: $(1) (see build/apt.log)" >&2; false; }; fi
endef

$(VENV)/.ready: pyproject.toml requirements/dev.txt
	@mkdir -p build
	@$(call step,1 of 4: Python environment $(VENV))
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "seldinger: found $$($(PYTHON) --version), wanted Python 3.11 or newer" >&2; exit 1; }
	@$(PYTHON) -c 'import ensurepip' 2>/dev/null || { $(call apt_install,$(DEBIAN_PYTHON)); }
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	@$(call step,2 of 4: packages (some minutes the first time))
	@$(PIP) install --require-hashes --requirement requirements/dev.txt 2>build/pip.log | $(PIP_PROGRESS); test $${PIPESTATUS[0]} = 0 || { cat build/pip.log >&2; exit 1; }
	@$(PIP) install --quiet --no-deps --editable . 2>build/pip.log || { cat build/pip.log >&2; exit 1; }
	@touch $@

# Kernels are compiled at set-up; after an edit each command compiles what it needs, and says so.
$(VENV)/.warm: $(VENV)/.ready | board-tools
	@$(call step,4 of 4: kernels)
	@$(BIN)/seldinger warm || echo "seldinger: the parts named above compile their kernels when they are first used" >&2
	@touch $@

warm: packages
	@$(BIN)/seldinger warm

# The simulated board needs a C compiler; the AVR tool chain is wanted, and its absence is said, not fatal.
board-tools: | $(VENV)/.ready
	@mkdir -p build
	@test -e $(VENV)/.warm || $(call step,3 of 4: compiler and simulator of the stepper board)
	@if [ "$(BOARD)" = native ] && command -v gcc >/dev/null; then :; \
	elif command -v avr-gcc >/dev/null && command -v gcc >/dev/null && [ -e /usr/include/simavr/sim_avr.h ] && [ -e /usr/include/libelf.h ]; then :; \
	else $(call apt_install,$(DEBIAN_BOARD)) || { command -v gcc >/dev/null && [ "$(BOARD)" != avr ] \
	  && echo "seldinger: no AVR tool chain: the firmware runs compiled for this machine (BOARD=native)" >&2; }; fi

# Tests that take minutes each.
long: setup
	@$(BIN)/python -m pytest -m long

# The same kernels as plain Python, so that a debugger works in them.
nojit: setup
	@NUMBA_DISABLE_JIT=1 $(BIN)/python -m pytest tests/realtime/test_modules.py tests/realtime/test_tick.py \
	  tests/realtime/test_mailbox.py tests/realtime/test_native_loop.py

bench: setup
	@$(BIN)/seldinger bench

prove: setup
	@$(BIN)/seldinger prove --cases 200 --seed 1

prove-small: setup
	@$(BIN)/seldinger prove --cases 24 --seed 1

prove-worlds: setup
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable ".[mujoco]"
	@$(BIN)/seldinger prove --cases 100 --seed $(SEED) --world all

live-study: setup
	@$(BIN)/python -m host.studies.live_study --jobs press round hand --quiet-hours 5 --fresh-hours 5 --planted 60 --doubled --out runs/live --docs docs/live.md

faults: setup
	@$(BIN)/seldinger faults --runs 2000 --seed 1 --jobs 2 --docs docs/reliability.md

# 200 runs in virtual time: the same runs on every machine. Exit status 1 if one breaks a rule.
faults-ci: setup
	@$(BIN)/seldinger faults --runs 200 --seed 1 --jobs 2 --board native

fuzz: setup
	@$(MAKE) -s -C firmware/fuzz run INPUTS=$(INPUTS) >build/fuzz.json && cat build/fuzz.json
	@$(MAKE) -s -C firmware/fuzz frames SEQUENCES=$(INPUTS)
	@$(BIN)/python -m host.studies.reliability_page docs/reliability.md <build/fuzz.json

# Crafted recordings and tables read by every reader of them; those that broke one stay in build/crafted_*.
fuzz-files: setup
	@$(BIN)/python -m tests.host.crafted_recordings $(FILES) $(SEED)
	@$(BIN)/python -m tests.host.diagnosis.crafted_tables $(FILES) $(SEED)

# The firmware's arithmetic for all inputs (firmware/proof/prove.c); needs Debian's frama-c-base.
proof:
	@$(MAKE) -s -C firmware proof

# Random kills, stalls, unplugged ports and full disks in contact, over all processes on the wall clock; some 40 s a run.
RUNS ?= 100
JOBS ?= 1
chaos: setup
	@$(BIN)/python -m host.studies.chaos --runs $(RUNS) --seed $(SEED) --jobs $(JOBS) --docs docs/reliability.md

soak: setup
	@$(BIN)/seldinger soak --minutes 120 --docs docs/reliability.md

format-check: $(VENV)/.ready
	@$(BIN)/ruff format --check .

# Wheel, empty environment, examples of docs/api.md. Downloads the dependencies.
.PHONY: wheel-test
wheel-test: $(VENV)/.ready
	@$(BIN)/python -m tests.seldinger.wheel_check

lint: $(VENV)/.ready
	@$(BIN)/ruff check .

types: $(VENV)/.ready
	@$(BIN)/mypy

# Versions and hashes of all packages that `make setup` installs, for every platform; made again after an edit of pyproject.toml.
LOCK = uv pip compile pyproject.toml --extra dev --generate-hashes --universal --python-version 3.11 --no-header --quiet
lock: $(VENV)/.ready
	@$(BIN)/$(LOCK) --output-file requirements/dev.txt

# The lock file satisfies pyproject.toml: resolving again with the locked versions preferred changes nothing.
lock-check: $(VENV)/.ready
	@mkdir -p build && cp requirements/dev.txt build/dev.txt
	@$(BIN)/$(LOCK) --output-file build/dev.txt
	@diff --brief requirements/dev.txt build/dev.txt || { echo "seldinger: requirements/dev.txt does not fit pyproject.toml; run make lock" >&2; exit 1; }

# Known weaknesses of the locked packages. Strict: a package that the index of weaknesses does not know fails; without it,
# nothing would be looked up on a machine that reaches another index, and the result would be the same as a clean one.
audit: $(VENV)/.ready
	@$(BIN)/pip-audit --strict --require-hashes --disable-pip --requirement requirements/dev.txt

clean:
	@rm -rf build runs

# Everything the project needs is installed by this file into .venv; no root, no system package.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
LOCKED := $(VENV)/.locked
STAMP  := $(VENV)/.installed
STUDY  := $(VENV)/.study
# Seconds instead of a minute or so where it is on PATH; `make UV=` does without.
ifeq ($(origin UV),undefined)
UV     := $(shell uv --version >/dev/null 2>&1 && echo uv)
endif
ARGS   ?=
PYTEST_ARGS ?=
DEB_ARGS ?=
HIL_ARGS ?=
BENCH_ARGS ?=
LOCK_ARGS ?=
PYTHONS ?= 3.11 3.12 3.13
PYTHON_TARGETS ?= run test
# Any that is there; pyenv's names on PATH start only the version that PYENV_VERSION names.
FIND_PYTHON = PYENV_VERSION=$* $(BIN)/uv python find --system --no-python-downloads
SOAK_S ?= 900
INTERFACE_EXAMPLES ?= 100

# Tests start a hundred processes: byte code is kept, in .venv, whatever the shell says of it (it is half of a start).
# numpy with a thread of its own for each test, as the command line has it.
BYTE_CODE := $(VENV)/byte-code
TESTS  := PYTHONDONTWRITEBYTECODE= PYTHONPYCACHEPREFIX=$(abspath $(BYTE_CODE)) OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest -p tests.run_times
BESIDE := -n 2 --dist loadgroup
# Three quarters of these tests' time is waiting, for virtual devices that move in real time.
WAITING := -n 4 --dist loadgroup
# Two of three groups at a time: with all three, deadlines are missed that are not ours.
MACHINES := -n 2 --dist loadgroup
# What only computes takes what others leave of the processors, and is not missed by them.
IDLE   := nice -n 19 env

.PHONY: help run test unit quick passes peers peer-agisostack test-pythons faults deb hil soak soak-virtual-time monitor hil-package hil-arm64 hil-usb web-test web-lock study study-test study-lock interface bench-hw check format lock clean mutants mutants-wide claims core-coverage

help: ## list the targets
	@grep -hE '^[a-z0-9-]+:.*##' $(MAKEFILE_LIST) | sed 's/:.*## /\t/' | expand -t 20

# The lock is installed as it stands: no resolver looks at an index (pip 22.2 to 23.0.1 would resolve it again and meet
# what is newest), nothing is compiled, each file has a hash of the lock, and `check` judges the whole. The environment
# is made anew when the lock changed or a set-up was interrupted, so it never holds what the lock does not name.
ifeq ($(UV),)
INSTALL := $(BIN)/python -m pip --disable-pip-version-check --quiet install --no-deps
AGREES  := $(BIN)/python -m pip --disable-pip-version-check check
else
INSTALL := $(UV) pip install --python $(BIN)/python --quiet --no-deps
AGREES  := $(UV) pip check --python $(BIN)/python
endif
# A tool's own words are shown when it fails, and what they come to.
LOG    := $(VENV)/set-up.log
define because
{ cat $(LOG) >&2; case "$$(cat $(LOG))" in \
*"DO NOT MATCH THE HASHES"* | *"Hash mismatch"*) why="a file is not the one that requirements.lock names: broken on its way, or changed on the index; empty the cache (pip cache purge, uv cache clean) and make again, and if it stays, take another index" ;; \
*[Cc]onnect* | *"timed out"* | *"dns error"*) why="the package index is not reached; look at the network, HTTPS_PROXY and PIP_INDEX_URL (UV_DEFAULT_INDEX for uv), then make again" ;; \
*"No space left"*) why="the disk is full; make room (300 MB to download, 1 GB in $(VENV)), then make again" ;; \
*"No matching distribution"* | *"No solution found"*) why="the index has no wheel of a pinned version for this Python on this machine; README says which have all (make PYTHON=/path/to/python3), or the index is not a whole one" ;; \
*) why="the cause stands above" ;; \
esac; echo "set-up of $(VENV) by $(if $(UV),uv,pip): $$why" >&2; exit 1; }
endef
# A Python that the system replaced leaves an environment without one.
ifneq ($(shell test -x $(BIN)/python && echo here),here)
.PHONY: $(LOCKED)
endif

$(LOCKED): requirements.lock
	@echo "setting up $(VENV) with $(if $(UV),uv,pip) (once; some minutes on a slow line)" >&2
	@$(PYTHON) -c 'import sys; sys.exit("graderd needs Python 3.11 or newer; make PYTHON=/path/to/python3.11") if sys.version_info < (3, 11) else None'
	@$(PYTHON) -m venv --clear $(VENV)
	@$(INSTALL) --only-binary :all: --require-hashes -r $< >$(LOG) 2>&1 || $(because)
	@touch $@

$(STAMP): $(LOCKED) pyproject.toml
	@$(INSTALL) --no-build-isolation --editable . >$(LOG) 2>&1 || $(because)
	@$(AGREES) >$(LOG) 2>&1 || { cat $(LOG) >&2; echo "set-up of $(VENV): requirements.lock and pyproject.toml do not agree; make lock" >&2; exit 1; }
	@touch $@

run: $(STAMP) ## drive the demonstration on the simulated grader (ARGS=--json for one object a line)
	@$(BIN)/graderd demo $(ARGS)

# Made once, before seven processes that would each make all of it; what cannot be collected, the tests tell.
$(BYTE_CODE): | $(STAMP)
	@$(TESTS) --collect-only -q >/dev/null 2>&1 || true

test: $(STAMP) | $(BYTE_CODE) ## run the tests; run times by file at the end of each part
	@$(IDLE) $(TESTS) $(BESIDE) -m pure $(or $(PYTEST_ARGS),tests/unit) >$(VENV)/pure.log 2>&1 & pure=$$!; \
	$(TESTS) $(WAITING) -m "not whole_machine and not pure" $(PYTEST_ARGS); waiting=$$?; \
	$(TESTS) $(MACHINES) -m whole_machine $(PYTEST_ARGS); whole=$$?; \
	wait $$pure; pure=$$?; cat $(VENV)/pure.log; [ $$waiting -eq 0 ] && [ $$whole -eq 0 ] && [ $$pure -eq 0 ]

unit: $(STAMP) | $(BYTE_CODE) ## run the pure tests: no process, no socket, seconds
	@$(TESTS) $(BESIDE) -m "pure and not slow" $(PYTEST_ARGS) tests/unit

quick: $(STAMP) | $(BYTE_CODE) ## run the tests of functions, contracts and wires that take no ten seconds each
	@$(TESTS) $(BESIDE) -m "not whole_machine and not slow" $(PYTEST_ARGS) tests/unit tests/contract tests/wire

peers: $(STAMP) ## lerobot on the virtual servo, in an environment of its own (downloads it once; needs Python 3.12)
	@test -x var/peers/lerobot/bin/python || { \
	python=$$(PYENV_VERSION=3.12 $(BIN)/uv python find --system --no-python-downloads 3.12) && $$python -m venv var/peers/lerobot \
	&& var/peers/lerobot/bin/python -m pip install --quiet --no-deps lerobot==0.6.1 \
	&& var/peers/lerobot/bin/python -m pip install --quiet deepdiff draccus dynamixel-sdk huggingface-hub numpy pyserial tqdm; }
	@$(TESTS) $(PYTEST_ARGS) tests/wire/test_dynamixel_lerobot.py

peer-agisostack: $(STAMP) ## AgIsoStack++ on the virtual bus, compiled here (downloads it once; needs git, cmake and a C++ compiler)
	@$(BIN)/python -m harness.peers.agisostack --build var/peers/agisostack

test-pythons: $(PYTHONS:%=test-python-%) ## both commands on each Python that README names, one after the other

test-python-%: $(STAMP)
	@python=$$($(FIND_PYTHON) $* 2>/dev/null || { $(BIN)/uv python install --quiet $* >&2 && $(FIND_PYTHON) $*; }) \
	|| { echo "test-pythons: no Python $* on this machine, nor can uv download one; install it, or PYTHONS=\"...\" for the others" >&2; exit 1; }; \
	$(MAKE) --no-print-directory VENV=.venv-$* PYTHON=$$python $(PYTHON_TARGETS)

passes: $(STAMP) ## whole passes on rig and daemon, 144 of them, more than an hour (ARGS="--sample 20", ARGS=--loop)
	@$(BIN)/python -m benchmarks.passes $(ARGS)

faults: $(STAMP) ## inject every fault in every phase of work (ARGS="--short --json" for a part of it)
	@$(BIN)/python -m harness.campaign $(ARGS)

deb: $(STAMP) ## build dist/graderd_VERSION_ARCH.deb (DEB_ARGS="--arch arm64"); needs dpkg-deb and git
	@$(BIN)/python packaging/build_deb.py $(DEB_ARGS)

hil: $(STAMP) ## hardware in the loop on a real kernel CAN stack (installs Debian packages once, as root)
	@hil/setup
	@$(BIN)/python packaging/build_deb.py --system-python --out var/hil/dist
	@PYTHONPATH=. $(BIN)/python -m hil.run $(HIL_ARGS)

soak: $(STAMP) ## the soak alone, SOAK_S seconds of it
	@hil/setup
	@$(BIN)/python packaging/build_deb.py --system-python --out var/hil/dist
	@PYTHONPATH=. $(BIN)/python -m hil.run --part soak --soak-s $(SOAK_S)

soak-virtual-time: $(STAMP) ## the same in virtual time: no deadline is missed on a busy machine (builds a kernel once)
	@hil/setup --kernel
	@$(BIN)/python packaging/build_deb.py --system-python --out var/hil/dist
	@PYTHONPATH=. $(BIN)/python -m hil.run --part soak --soak-s $(SOAK_S) --virtual-time

hil-package: $(STAMP) ## install, use, upgrade, purge the package in a clean Debian root (not in every CI run)
	@hil/setup --usb
	@$(MAKE) --no-print-directory deb
	@PYTHONPATH=. $(BIN)/python -m hil.package $(HIL_ARGS)

hil-arm64: $(STAMP) ## install and use the arm64 package in a bare arm64 root, emulated (not in every CI run)
	@hil/setup --arm64
	@$(MAKE) --no-print-directory deb DEB_ARGS="--arch arm64"
	@PYTHONPATH=. $(BIN)/python -m hil.arm64

hil-usb: $(STAMP) ## QEMU: an FTDI adapter pulled and plugged, two SJA1000 controllers (before a release; 5 minutes or so)
	@hil/setup --usb
	@$(MAKE) --no-print-directory deb
	@PYTHONPATH=. $(BIN)/python -m hil.usb $(HIL_ARGS)

web-test: $(STAMP) ## the operator page in a headless Chromium, on rig and daemon (installs Debian's chromium once, as root)
	@tests/browser/setup
	@$(INSTALL) --require-hashes -r tests/browser/requirements.txt >$(LOG) 2>&1 || $(because)
	@$(TESTS) -o addopts="-ra --strict-markers --strict-config" $(PYTEST_ARGS) tests/browser

study: $(STUDY) ## install what `graderd study` needs into .venv (once, 200 MB to download)

study-test: $(STUDY) ## the study's tests on its engine: single grains, small piles, killed workers
	@$(TESTS) -n 2 --dist loadfile -o addopts="-ra --strict-markers --strict-config" $(PYTEST_ARGS) tests/study

$(STUDY): $(STAMP) studies/requirements.lock
	@$(INSTALL) --only-binary :all: --require-hashes -r studies/requirements.lock >$(LOG) 2>&1 || $(because)
	@touch $@

interface: $(STAMP) ## the interface against its own description, by Schemathesis on rig and daemon (INTERFACE_EXAMPLES a path)
	@GRADERD_INTERFACE_EXAMPLES=$(INTERFACE_EXAMPLES) $(TESTS) $(PYTEST_ARGS) tests/fault/test_openapi.py

bench-hw: $(STAMP) ## tests against real hardware; asks before each motion (needs GRADERD_BENCH=1 and a terminal)
	@PYTHONPATH=. $(BIN)/python -m hil.bench $(BENCH_ARGS)

monitor: $(STAMP) ## a million random ticks, and a thousand moves of the lifts of each kind, judged from outside (half an hour)
	@GRADERD_MONITOR_TICKS=1000000 $(BIN)/python -m pytest -q tests/unit/test_core_tick_monitor.py
	@$(BIN)/python -m benchmarks.lift_pair

mutants: $(STAMP) ## mutate gate, state machine and fault monitor; list what the tests let live
	@$(BIN)/python -m mutmut run $(ARGS)
	@$(BIN)/python -m mutmut results

mutants-wide: $(STAMP) ## seed thirty mistakes in runtime, drivers and interface; each must be noticed by its nearest tests
	@$(BIN)/python -m harness.mutants_wide $(ARGS)

claims: $(STAMP) ## take out what the safety concept claims, one by one; the tests it names must notice
	@$(BIN)/python -m harness.claims $(ARGS)

core-coverage: $(STAMP) ## branch coverage of gate, state machine and fault monitor by their own tests (must be 100 %)
	@$(BIN)/python -m pytest -q -n 2 --cov=graderd.core.gate --cov=graderd.core.machine --cov=graderd.core.faults --cov-branch --cov-fail-under=100 --cov-report=term-missing tests/unit/test_core_gate.py tests/unit/test_core_machine.py tests/unit/test_core_machine_model.py tests/unit/test_core_golden.py tests/unit/test_fault_catalogue.py

check: $(STAMP) ## lint, types, import contracts
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/mypy
	@$(BIN)/lint-imports --no-cache

format: $(STAMP) ## apply the formatter and the safe fixes
	@$(BIN)/ruff check --fix .
	@$(BIN)/ruff format .

# All of them but what a study takes, which would be half as much again.
EXTRAS = $$($(BIN)/python -c 'import tomllib; extras = tomllib.load(open("pyproject.toml", "rb"))["project"]["optional-dependencies"]; print(*(f"--extra {name}" for name in extras if name != "study"))')

lock: $(LOCKED) ## pin what pyproject.toml names; pins in force stay (LOCK_ARGS="--upgrade-package numpy", --upgrade for all)
	@$(BIN)/uv pip compile --universal --python-version 3.11 $(EXTRAS) --generate-hashes --custom-compile-command "make lock" --quiet --output-file requirements.lock $(LOCK_ARGS) pyproject.toml

web-lock: $(LOCKED) ## pin what tests/browser/requirements.in names (LOCK_ARGS as for lock)
	@$(BIN)/uv pip compile --universal --python-version 3.11 --generate-hashes --custom-compile-command "make web-lock" --quiet --constraint requirements.lock --output-file tests/browser/requirements.txt $(LOCK_ARGS) tests/browser/requirements.in

study-lock: $(LOCKED) ## pin what the extra study needs beside requirements.lock (LOCK_ARGS as for lock)
	@$(BIN)/uv pip compile --universal --python-version 3.11 --extra study --generate-hashes --custom-compile-command "make study-lock" --quiet --constraint requirements.lock --output-file studies/requirements.lock $(LOCK_ARGS) pyproject.toml

clean: ## remove what the targets above made
	rm -rf $(VENV) $(PYTHONS:%=.venv-%) build dist *.egg-info .mypy_cache .ruff_cache .pytest_cache .import_linter_cache .hypothesis

# Two commands on a fresh machine: `make run` and `make test`. Needs Python >= 3.11 with venv, make, git.
PYTHON ?= $(shell for p in python3 python3.13 python3.12 python3.11; do \
	$$p -c 'import sys, venv, ensurepip; sys.exit(sys.version_info < (3, 11))' >/dev/null 2>&1 && echo $$p && break; done)
VENV := .venv
BIN := $(VENV)/bin
PRODUCT := $(VENV)/.product
PACKAGES := $(VENV)/.packages
STAMP := $(VENV)/.installed
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt
OUT ?= runs/default
VERSION := $(shell sed -n 's/^version = "\(.*\)"/\1/p' pyproject.toml)

# One thread per process: the linear algebra here is small, and two processes with two threads each fight over two cores.
export OMP_NUM_THREADS := 1
export OPENBLAS_NUM_THREADS := 1
export NO_MKDOCS_2_WARNING := 1
# Without bytecode every process that a test starts compiles a thousand modules again, which takes five seconds.
unexport PYTHONDONTWRITEBYTECODE
# A process a core, from two to four: each takes .8 GB.
WORKERS ?= $(shell n=$$(nproc 2>/dev/null || echo 2); echo $$((n < 2 ? 2 : n > 4 ? 4 : n)))
PYTEST := $(BIN)/python -m pytest -n $(WORKERS) --dist worksteal -q

.PHONY: help install run test test-all test-long lint types wheel dist check docs clean

help:
	@echo "make run    install into .venv and run the default arm end to end (OUT=$(OUT))"
	@echo "make test   everything that guards behaviour   make test-all   with what takes longer   make test-long   Monte Carlo"
	@echo "make frozen some eighty questions: which answers moved from the stored ones (STORE=1 stores them)"
	@echo "make docs   the documentation as a site, build/site/index.html, with a gallery of pages"
	@echo "make wheel  a wheel with the newest dependencies, tried on every Python from 3.11 to 3.13 that is here"
	@echo "make dist   wheel and source archive in build/dist, the same bytes from the same commit"
	@echo "make check  what CI runs: tests, lint, types, wheel"

# What a user needs. Not compiled to bytecode: of the large packages a run imports a small part.
$(PRODUCT): pyproject.toml constraints.txt
	@test -n "$(PYTHON)" || { echo "flexlink needs Python 3.11 or newer with venv"; exit 2; }
	@echo "installing flexlink and its pinned dependencies into $(VENV) (half a minute, once)"
	@$(PYTHON) -m venv $(VENV)
	@$(PIP) --no-compile -e '.[logs,mujoco]'
	@touch $@

$(PACKAGES): $(PRODUCT)
	@echo "installing what tests and documentation need (a minute, once)"
	@$(PIP) -e '.[dev]'
	@touch $@

# The run fills the cache of compiled code: code compiled in the same process may round otherwise than code from the
# cache, and a killed run must resume to the same digits.
$(STAMP): $(if $(filter-out run,$(or $(MAKECMDGOALS),help)),$(PACKAGES),$(PRODUCT))
	@echo "compiling the numerical kernels (half a minute, once)"
	@$(BIN)/flexlink run --config .ci/every_kernel.toml --out $(VENV)/compiled --replace >/dev/null || test $$? -eq 3
	@rm -rf $(VENV)/compiled
	@touch $@

install: $(STAMP) $(PACKAGES)

run: $(STAMP)
	$(BIN)/flexlink run --out $(OUT) --replace

test: $(STAMP) $(PACKAGES)
	$(PYTEST) -m "not slow and not long"

test-all: $(STAMP) $(PACKAGES)
	$(PYTEST) -m "not long" --durations=100 --durations-min=1

# Monte Carlo that decides nothing from day to day: hours apart, its results kept with commit and seeds.
test-long: $(STAMP) $(PACKAGES)
	$(PYTEST) -m long

# In six minutes of two cores; exit code 1 where an answer moved. Measured machines: FLEXLINK_DATA, or ../shared/data.
frozen: $(STAMP) $(PACKAGES)
	$(BIN)/python -m benchmarks.frozen_answers $(if $(STORE),--store)

lint: $(PACKAGES)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports --no-logo

types: $(PACKAGES)
	$(BIN)/mypy

# Needs no installation of ours: it makes its own, with the newest dependencies, for every Python there is.
wheel:
	./.ci/wheel

# The same bytes from the same commit: files in the wheel carry the time of the commit.
dist: $(PACKAGES)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check build
	SOURCE_DATE_EPOCH=$$(git log -1 --format=%ct) $(BIN)/python -m build --wheel --outdir build/dist .
	git archive --format=tar.gz --prefix=flexlink-$(VERSION)/ --output=build/dist/flexlink-$(VERSION).tar.gz HEAD

check: test-all lint types wheel

# Pages of the gallery are drawn once; make clean has them drawn again.
docs: $(STAMP) build/gallery/.drawn
	$(BIN)/python -m mkdocs build --strict -q

build/gallery/.drawn: $(STAMP)
	mkdir -p build/gallery
	$(BIN)/flexlink simulate --out build/gallery/logs
	$(BIN)/flexlink look build/gallery/logs/09_prbs.csv --out build/gallery/look.html
	$(BIN)/flexlink identify build/gallery/logs/0*_V_rms_*.csv --validation build/gallery/logs/09_prbs.csv \
		--output hub_angle_rad --integrators 1 --delay 1 --real 1 --pairs 2 --response "without friction" --report build/gallery/identify.html
	$(BIN)/flexlink run --out build/gallery/run --replace
	$(BIN)/flexlink diagnose examples/gap_case --out build/gallery/diagnosis --replace
	touch $@

clean:
	rm -rf $(VENV) runs build *.egg-info
	find . \( -name "*.nb[ic]" -o -name "*.template" \) -delete

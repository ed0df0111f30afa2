# Both targets need Python 3.11 or newer and nothing else: they make their own .venv.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/$(if $(filter Windows_NT,$(OS)),Scripts,bin)
# One process a core; tests of one file share what they build.
PYTEST := $(BIN)/python -m pytest -n auto

.PHONY: demo test check docs pictures campaign platforms sanitised clean

demo: $(VENV)/installed
	$(BIN)/cosim demo --out demo --overwrite

test: $(VENV)/installed
	$(PYTEST)

# What CI runs after `make test`: lint, types, the slow tests (the FMUs in every importer among them), the stored
# results and the main job on a small budget.
check: $(VENV)/installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(MAKE) docs
	$(PYTEST) -m slow
	$(BIN)/cosim results check
	$(BIN)/cosim demo --samples 2000 --steps 200 --out build/demo --overwrite

# The figures of the stored studies, which the site shows; drawn anew where a table is newer.
build/figures: $(wildcard results/*.toml results/*/*.csv cosim/figures/* cosim/studies/*.py) | $(VENV)/installed-dev
	$(BIN)/cosim results draw
	mkdir -p build
	touch $@

# The documentation as a site, in build/site; any warning is an error.
docs: build/figures
	$(BIN)/python -m mkdocs build --strict --site-dir build/site

# The pictures of README and docs/results.md, from the stored tables; committed, since both are read without a build.
pictures: $(VENV)/installed-dev
	$(BIN)/python docs/pictures.py

# What takes many minutes a test and is run by hand.
campaign: $(VENV)/installed-dev
	$(BIN)/python -m pytest -m campaign

# Binaries for every platform; those for ARM and Windows give the native ones' bits under qemu and wine.
platforms: $(VENV)/installed-dev
	$(PYTEST) -m platforms

# The exported C, of plants and controllers, under AddressSanitizer and UBSan: once per release.
sanitised: $(VENV)/installed
	$(PYTEST) -m sanitised

$(BIN)/python:
	$(PYTHON) -m venv $(VENV)

$(VENV)/installed: pyproject.toml constraints.txt | $(BIN)/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[test]'
	touch $@

$(VENV)/installed-dev: $(VENV)/installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev,fmi-check,cross]'
	touch $@

clean:
	rm -rf $(VENV) demo build dist *.egg-info

# make demo | test | lint | gates | bench | conformance
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
STAMP  := $(VENV)/installed.stamp

.PHONY: demo test lint gates bench conformance clean
# constraints.txt pins what was tested on one Python version; other versions resolve freely.
$(STAMP): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "gonio needs Python 3.11 or newer; say which with: make PYTHON=python3.12 $(MAKECMDGOALS)"; exit 2; }
	$(PYTHON) -m venv $(VENV)
	@if $(BIN)/python -c 'import sys; sys.exit(sys.version_info[:2] != (3, 11))'; then pin="-c constraints.txt"; fi; \
	  echo $(BIN)/pip install -e '.[test]' $$pin; $(BIN)/pip install --quiet --disable-pip-version-check -e '.[test]' $$pin
# other programs' readers, for the conformance of exported files; where they cannot be installed, those tests are skipped
	@if $(BIN)/python -c 'import sys; sys.exit(sys.version_info[:2] != (3, 11))'; then pin="-c constraints.txt"; fi; \
	  $(BIN)/pip install --quiet --disable-pip-version-check -e '.[check]' $$pin 2>/dev/null || \
	  echo "mitsuba, pyradiance and pywincalc cannot be installed here; tests of exported files against them are skipped"
	@touch $@

demo: $(STAMP)
	$(BIN)/gonio demo --out runs/demo

# Two workers, a file of tests to each: the kernels of a file are compiled once.
test: $(STAMP)
	$(BIN)/python -m pytest -m "not gate" -n 2 --dist loadfile

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

gates: $(STAMP)
	$(BIN)/python -m pytest -m gate -s

# The renderer and NUTS are peers worth having, and large; where they cannot be installed, their rows are left out.
bench: $(STAMP)
	@$(BIN)/python -c 'import mitsuba, numpyro' 2>/dev/null || { \
	  if $(BIN)/python -c 'import sys; sys.exit(sys.version_info[:2] != (3, 11))'; then pin="-c constraints.txt"; fi; \
	  $(BIN)/pip install --quiet --disable-pip-version-check -e '.[bench]' $$pin 2>/dev/null || \
	  echo "mitsuba or numpyro cannot be installed here; their rows are left out"; }
	$(BIN)/python -m tests.benchmarks

# pySCATMECH comes as source: a C++ compiler and some minutes.
conformance: $(STAMP)
	@if $(BIN)/python -c 'import sys; sys.exit(sys.version_info[:2] != (3, 11))'; then pin="-c constraints.txt"; fi; \
	  $(BIN)/pip install --quiet --disable-pip-version-check -e '.[conformance]' $$pin
	$(BIN)/python -m pytest tests/conformance/test_third_party.py
	$(BIN)/python -m tests.conformance --write

clean:
	rm -rf $(VENV) build dist .mypy_cache .ruff_cache .pytest_cache .import_linter_cache

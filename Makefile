# `make demo` and `make test` need only Python 3.11 or later and make.
PYTHON ?= python3
VENV   ?= .venv
BIN    := $(VENV)/bin
OUT    ?= demo

.PHONY: demo test slow pages docs lint clean

# One stamp per set of extras: pip runs again only when pyproject.toml changes.
$(VENV)/.report: pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[report]'
	touch $@

$(VENV)/.dev: pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[dev]'
	touch $@ $(VENV)/.report

$(VENV)/.docs: pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[docs]'
	touch $@

demo: $(VENV)/.report
	$(BIN)/jaxeit calibrate data/sessions/testbed_grid.h5 --location edge-spline --test data/sessions/testbed_presses.h5 \
	    -o $(OUT)/calibration.h5 --report $(OUT)/report.html

test: $(VENV)/.dev
	$(BIN)/python -m pytest -m "not slow"

# Programs compiled as users have them, and annotations not checked.
AS_USERS := XLA_FLAGS=--xla_backend_optimization_level=3 JAXTYPING_DISABLE=1

slow: $(VENV)/.dev
	$(AS_USERS) $(BIN)/python -m pytest -o faulthandler_timeout=1800 -m slow

# The tests that run what the pages, the docstrings and the examples show; tests/test_page_blocks.py holds the list.
SHOWN := test_batches test_docs test_eidors_pages test_examples test_notebook test_page_blocks test_page_commands \
    test_program_cache test_programs test_readme test_release test_site test_tutorials batch/test_random_frames export/test_c_header \
    export/test_lerobot_page record/test_wire registry/test_own_classes simulators/test_mujoco tanks/test_tanks

pages: $(VENV)/.dev
	$(AS_USERS) $(BIN)/python -m pytest -o faulthandler_timeout=1800 $(SHOWN:%=tests/%.py)

# build/site, to be read without a network; a broken link is an error.
docs: $(VENV)/.docs  # --quiet would also silence what --strict counts
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict
	@echo "open build/site/index.html"

lint: $(VENV)/.dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

clean:
	rm -rf $(VENV) $(OUT) build *.egg-info

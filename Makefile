PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
STAMP  := $(VENV)/.installed

.PHONY: setup demo test test-fast test-full mutants bench photometric docs browse lint dist clean

setup: $(STAMP)

# Installed again when pyproject.toml changes: an editable install follows every other file by itself
$(STAMP): pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10))' || \
	    { echo "Rimlight needs Python >= 3.10; try: make setup PYTHON=python3.12" >&2; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || \
	    { echo "Python's venv module is missing; on Debian and Ubuntu: sudo apt install python3-venv" >&2; exit 1; }
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --editable '.[dev]'
	@touch $@

demo: setup
	$(BIN)/python -m rimlight demo --out demo

# All but the slow ones (tests/tiers.py). Two workers, each with all threads: the compiler, not the kernels, is what
# small tests wait for
test: setup
	$(BIN)/python -m pytest -n 2 --dist worksteal --durations 30 -m "not slow"

# A minute's worth of them
test-fast: setup
	$(BIN)/python -m pytest -n 2 --dist worksteal -m fast

# All, with many samples, and random ordinary scenes: 300 take about an hour, or as many as: make test-full SCENES=1000
SCENES ?= 300
test-full: setup
	RIMLIGHT_FULL=1 RIMLIGHT_SCENES=$(SCENES) $(BIN)/python -m pytest -n 2 --dist worksteal --durations 30

# Deliberate faults, one at a time: which tests notice each?
mutants: setup
	$(BIN)/python tests/mutants.py

# All of them take about three quarters of an hour; or one: make bench NAME=scaling
NAME ?= film_boundary soft_shadow hard_shadow every_jump depth_map glossy global_illumination scaling rig bidirectional bidirectional_derivatives integration reflectance photometric_stereo single_image
bench: setup
	for name in $(NAME); do $(BIN)/python tests/benchmarks/bm_$$name.py || exit 1; done

# The numbers of photometric stereo, at one commit. DILIGENT is a copy of that data set, CAMERA its intrinsic matrix: some
# hours
DILIGENT ?= ../shared/data/diligent
CAMERA ?= $(DILIGENT)/bear_depth/K.txt
photometric: setup
	$(BIN)/python tests/benchmarks/bm_photometric_stereo.py
	$(BIN)/python tests/benchmarks/glazed_figures.py
	$(BIN)/python tests/benchmarks/diligent.py $(DILIGENT) --camera $(CAMERA)
	$(BIN)/python tests/random_photometric.py --seeds 4000 4200 --processes 2

DEMO := docs/_build/extra/demo/index.html
$(DEMO): inverse/demo.py $(STAMP)
	$(BIN)/python -m rimlight demo --out $(@D)

docs: setup $(DEMO)
	$(BIN)/python -m sphinx -W --keep-going -b html docs docs/_build/html

# Accessibility of the pages, and their search, in a browser; says so and does nothing where there is none
browse: docs
	$(BIN)/python tests/browse.py docs/_build/html

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/codespell
	rm -rf build/types && mkdir -p build/types/rimlight
	ln -s $(CURDIR)/plugins/* $(CURDIR)/edge_sampling $(CURDIR)/inverse $(CURDIR)/scenes build/types/rimlight
	$(BIN)/mypy

# A wheel and an archive of the sources, in dist/; then the wheel alone, in an empty environment of each Python
PYTHONS ?= python3
dist: setup
	$(BIN)/python tests/distribution.py $(PYTHONS)

clean:
	rm -rf $(VENV) build dist demo docs/_build .mypy_cache .pytest_cache .ruff_cache *.egg-info
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

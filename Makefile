# make demo: the main job on the shipped capture.  make test: all tests.  Both from a bare clone.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
DEMO := demo
export PIP_DISABLE_PIP_VERSION_CHECK = 1

.PHONY: demo test lint scenes clean

$(VENV)/installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[dev,scenes]'
	touch $@

demo: $(VENV)/installed
	$(BIN)/catacaustics reconstruct data_samples/ball $(DEMO) --minutes 4 --image-size 480
	$(BIN)/catacaustics render $(DEMO)/run $(DEMO)/film.mp4 --width 480 --seconds 5

test: $(VENV)/installed
	$(BIN)/python -m pytest

lint: $(VENV)/installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright

scenes: $(VENV)/installed
	for scene in vase bowl blade kettle mirror pair; do $(BIN)/python tools/make_scene.py $$scene scenes/$$scene || exit 1; done

clean:
	rm -rf $(VENV) $(DEMO) scenes runs build

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready

.PHONY: run test bench soak-recordings check install uninstall test-systemd clean

# The paper's closed loop for ten seconds, installed first where it is not.
run: $(READY)
	$(BIN)/rtloop run deploy/paper.toml --duration 10

test: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright --pythonpath $(BIN)/python
	$(BIN)/lint-imports
	$(BIN)/pytest

bench: $(READY)
	$(BIN)/python -m tests.benchmarks

# Killed runs, damaged files, other processors, an hour at 10 kHz: about half an hour, 2 GB in the temporary folder.
soak-recordings: $(READY)
	$(BIN)/python -m tests.soak.recordings

check: $(READY)
	$(BIN)/rtloop check deploy/paper.toml

$(READY): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[test]'
	$(BIN)/python -m rtloop.warm
	touch $@

# As root; PREFIX, DESTDIR and PIP_ARGS (such as "--no-index --find-links FOLDER") are explained in deploy/install.
install uninstall:
	PYTHON='$(PYTHON)' PREFIX='$(PREFIX)' DESTDIR='$(DESTDIR)' PIP_ARGS='$(PIP_ARGS)' deploy/install $@

# As root, with debootstrap and systemd-container: the installed service under a real systemd, in a Debian container.
test-systemd: $(READY)
	PYTHON='$(abspath $(BIN)/python)' tests/systemd/run

clean:
	rm -rf $(VENV) build dist *.egg-info

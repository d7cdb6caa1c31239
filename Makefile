# Two commands on a fresh machine: `make dock` and `make test`. Each installs what it needs into .venv first.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
CELL ?= sim/cells/fuselage-can.toml
RUNS ?= runs
SEEDS ?= 100
FUZZ_SECONDS ?= 60

.PHONY: dock test lint bench study wires fuzz clean

dock: $(VENV)/.installed
	@mkdir -p $(RUNS)
	$(BIN)/docking dry-run $(CELL) --report $(RUNS)/report.html
	@echo "Report: $(RUNS)/report.html"

# Real-time tests run last and alone: their ticks must not wait for a Monte Carlo.
test: $(VENV)/.installed-dev lint
	$(BIN)/pytest -n 2 -m "not wires"; others=$$?; \
	$(BIN)/pytest -m wires; exit $$((others | $$?))

lint: $(VENV)/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

bench: $(VENV)/.installed-dev
	$(BIN)/python -m tests.bench

study: $(VENV)/.installed-dev
	$(BIN)/docking study dock --seeds $(SEEDS)

wires: $(VENV)/.installed-dev
	$(BIN)/pytest -n 4 -m wires tests/e2e --all-cells

# Each parser of the serial drivers under coverage-guided fuzzing for so long.
fuzz: $(VENV)/.installed-dev
	$(BIN)/pip install --quiet --constraint constraints.txt --editable '.[fuzz]'
	@mkdir -p $(RUNS)
	for parser in line geocom ndi vectornav; do \
		$(BIN)/python -m tests.fuzz $$parser -max_total_time=$(FUZZ_SECONDS) -max_len=600 -artifact_prefix=$(RUNS)/ || exit 1; \
	done

$(VENV)/.installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --constraint constraints.txt --editable '.[report]'
	@touch $@

NODE_PEER := tests/peers/programs/modbus_serial

# The one peer from npm lies beside the packages, installed by the node of a wheel as its lock file says.
$(VENV)/.installed-dev: $(VENV)/.installed $(NODE_PEER)/package-lock.json
	$(BIN)/pip install --quiet --constraint constraints.txt --editable '.[dev]'
	@mkdir -p $(VENV)/modbus_serial
	cp $(NODE_PEER)/package.json $(NODE_PEER)/package-lock.json $(VENV)/modbus_serial
	$(BIN)/python -m tests.peers.programs.install_modbus_serial $(VENV)/modbus_serial
	@touch $@

clean:
	rm -rf $(VENV) $(RUNS) build *.egg-info

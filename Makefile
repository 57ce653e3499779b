# What a person types: make demo, make test. Both set up .venv from constraints.txt first and need nothing else.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
# one thread for linear algebra: the harness runs processes in parallel instead
export OMP_NUM_THREADS := 1
export OPENBLAS_NUM_THREADS := 1
# what Python compiled is kept beside its source also where the surroundings forbid it (images for containers do):
# the tests start many processes, and each would compile all that it imports once more
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo test nightly style lint bench docs clean

$(READY): pyproject.toml lab/pyproject.toml constraints.txt
	@echo "setting up $(VENV) (a minute or two, once)"
	@$(PYTHON) -m venv $(VENV)
	@$(BIN)/python -m pip install --quiet --no-compile --disable-pip-version-check -c constraints.txt -e ".[dev]" -e lab
	@touch $@

# the benchmark table, then one loop closed: Bullet's own joint friction, found in the log of a one-joint arm
demo: $(READY)
	@rm -rf demo-out && mkdir demo-out
	$(BIN)/sysid bench quick --out demo-out/quick
	$(BIN)/sysid simulate arm-bullet --scenario multisine --option joint_friction=0.15 \
	  --scenario-option noise=0.001 --seed 1 -o demo-out/arm.csv
	$(BIN)/sysid simulate arm-bullet --scenario multisine --option joint_friction=0.15 \
	  --scenario-option noise=0.001 --seed 1 --role validation/0 -o demo-out/arm-validation.csv
	$(BIN)/sysid close-loop demo-out/arm.csv --model pendulum --validation demo-out/arm-validation.csv --out demo-out/arm
	@echo; echo "reports: $(CURDIR)/demo-out/quick/report.html"; echo "         $(CURDIR)/demo-out/arm/report.html"

style: $(READY)
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/lint-imports

lint: style
	@$(BIN)/mypy

# the gate: lint, types, import rules, doctests, and all tests but those that take long;
# the types are checked beside the tests, which keeps both processors busy, and are told of at the end
test: style
	@told=$$(mktemp); trap 'rm -f "$$told"' EXIT; $(BIN)/mypy >"$$told" 2>&1 & types=$$!; \
	trap 'kill $$types 2>/dev/null; exit 130' INT TERM; \
	$(BIN)/python -m pytest -n 2 --dist worksteal -m "not slow"; tests=$$?; \
	wait $$types; typed=$$?; [ $$typed -eq 0 ] || cat "$$told"; [ $$tests -eq 0 ] && [ $$typed -eq 0 ]

# what takes long: whole loops on recordings, fleets, interrupts, plug-ins installed by pip
nightly: $(READY)
	@$(BIN)/python -m pytest -n 2 --dist worksteal -m slow
	@$(BIN)/python lab/mutations.py

bench: $(READY)
	@for script in benchmarks/bench_*.py; do echo "== $$script"; $(BIN)/python $$script || exit 1; done

# the site: site/index.html, with every option from the sources; broken links and pages are errors
docs: $(READY)
	$(BIN)/python docs/make_reference.py
	$(BIN)/mkdocs build --quiet --strict
	$(BIN)/python docs/check_site.py site
	@echo "site: $(CURDIR)/site/index.html"

clean:
	rm -rf $(VENV) build dist demo-out site

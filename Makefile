# Commands for developers of RoboXim; `make help` lists them. CI calls the same commands.
# All commands but help, setup and clean run the set-up first. It does nothing when nothing has changed.

.DEFAULT_GOAL := help
SHELL := /bin/bash
BIN := .venv/bin
# Container images often set this variable. Without compiled modules each process of a run starts a second later.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help setup try-lerobot demo test test-thorough test-slow test-pythons test-lowest fuzz format lint types docs colcon verify-conventions verify-rlds verify-lerobot planner-peers render-peers policy-octo policy-rt1 zero-shot photo scale soak robot-visuals release lock clean clean-all

help: ## list the commands
	@grep -hE '^[a-zA-Z_%-]+:.*## ' $(MAKEFILE_LIST) | sed -e 's/%/NAME/' | \
	  awk -F ':.*## ' '{ printf "  make %-13s %s\n", $$1, $$2 }'

setup: ## install everything into this checkout (.tools/, .venv/); PYTHON=... chooses the Python (3.11 to 3.13)
	@PYTHON="$(PYTHON)" sh scripts/set_up.sh

demo: setup ## run the main job: generate, record, export, train, evaluate; ARGS="..." adds options
	@$(BIN)/roboxim demo $(ARGS)

test: setup ## run the default tests (not those marked thorough, slow, fuzz or gpu), one process a core; ARGS="-k name" adds options
	$(BIN)/pytest -n logical --maxprocesses 4 --dist loadfile $(ARGS)

test-thorough: setup ## run the tests marked thorough, which CI runs after the default ones
	$(BIN)/pytest -n logical --maxprocesses 4 -m "thorough and not slow and not gpu" $(ARGS)

test-slow: setup ## run the tests marked slow
	$(BIN)/pytest -m "slow and not gpu" $(ARGS)

test-pythons: setup ## run the golden hashes and the smoke demo on the other Pythons, which uv installs; PYTHONS="3.12 3.13"
	@$(BIN)/python scripts/try_pythons.py $(or $(PYTHONS),3.12 3.13)

test-lowest: setup ## run the smoke demo with the lowest versions that the metadata allow; PYTHONS=3.11
	@$(BIN)/python scripts/try_pythons.py $(or $(PYTHONS),3.11) --lowest

fuzz: setup ## mutate files of every format 100 times each; ARGS="-k name" adds options
	$(BIN)/pytest -n logical --maxprocesses 4 -m fuzz $(ARGS)

format: setup ## format the code and fix what ruff can fix
	$(BIN)/ruff check --fix --show-fixes
	$(BIN)/ruff format

lint: setup ## check style and format without changing files
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/hadolint Dockerfile

types: setup ## type-check every package strictly
	$(BIN)/mypy

bench-%: setup ## run benchmarks/*/NAME.py; ARGS="--quick --json FILE" adds options
	@test -f "$(wildcard benchmarks/*/$*.py)" || { echo "No benchmark '$*'; expected one of:" \
	  $(sort $(notdir $(basename $(filter-out benchmarks/peers/%,$(wildcard benchmarks/*/[a-z]*.py))))); exit 2; }
	$(BIN)/python -m $(subst /,.,$(basename $(wildcard benchmarks/*/$*.py))) $(ARGS)

soak: setup ## generate 10,000 episodes without cameras and 2,000 with; draw memory, handles, threads and disk; ARGS="--out DIR"
	$(BIN)/python -m benchmarks.graph.soak $(ARGS)

docs: setup ## build the documentation into site/
	@$(BIN)/python scripts/make_environment.py docs
	$(BIN)/python scripts/docs.py $(ARGS)

verify-conventions: setup ## compare conventions with genuine clients and robosuite: SOURCE="../openpi ../openvla-oft" runs clones' code
	@$(BIN)/python scripts/make_environment.py verify-conventions
	$(BIN)/python scripts/verify_conventions.py $(if $(SOURCE),--source $(SOURCE)) $(ARGS)

verify-rlds: setup ## read an exported dataset with TensorFlow Datasets: DATASET=path
	@test -n "$(DATASET)" || { echo "DATASET is not set; run: make verify-rlds DATASET=folder"; exit 2; }
	@$(BIN)/python scripts/make_environment.py verify-rlds
	.tools/verify-rlds-env/bin/python scripts/verify_rlds.py "$(DATASET)" $(ARGS)

verify-lerobot: setup ## read an exported LeRobot or HDF5 dataset with lerobot or robomimic: DATASET=path
	@test -n "$(DATASET)" || { echo "DATASET is not set; run: make verify-lerobot DATASET=folder"; exit 2; }
	@if grep -qs '"v2' "$(DATASET)/meta/info.json"; then name=verify-lerobot-2; else name=verify-lerobot; fi; \
	  script=verify_lerobot.py; test -f "$(DATASET)/meta/info.json" || script=verify_hdf5.py; \
	  $(BIN)/python scripts/make_environment.py $$name && \
	  .tools/$$name-env/bin/python scripts/$$script "$(DATASET)" $(ARGS)

planner-peers: setup ## install mplib, toppra and RoboPlan, so that bench-planner measures them too
	@$(BIN)/python scripts/make_environment.py planner-mplib
	@$(BIN)/python scripts/make_environment.py planner-roboplan

colcon: setup ## build the tree with PyPI's colcon against the ROS wheels, into .tools/colcon/
	@$(BIN)/python scripts/make_environment.py colcon
	@$(BIN)/python scripts/colcon.py $(ARGS)

render-peers: setup ## install MuJoCo and robosuite, so that bench-render and bench-control_loop measure them too
	@$(BIN)/python scripts/make_environment.py robosuite

policy-octo: setup ## serve Octo on openpi's wire: CHECKPOINT=folder or hf://name SOURCE="octo dlimp"; ARGS="--port 8000"
	@test -n "$(CHECKPOINT)$$OCTO_CHECKPOINT" || { echo "CHECKPOINT is not set; run: make policy-octo" \
	  "CHECKPOINT=folder SOURCE=\"octo dlimp\" (clones of octo-models/octo and kvablack/dlimp); see docs/how-to/policies.md"; exit 2; }
	@$(BIN)/python scripts/make_environment.py policy-octo
	.tools/policy-octo-env/bin/python src/roboxim_policies/servers/octo.py $(if $(CHECKPOINT),--checkpoint "$(CHECKPOINT)") \
	  $(foreach folder,$(SOURCE),--source "$(folder)") $(ARGS)

policy-rt1: setup ## serve RT-1-X on openpi's wire: CHECKPOINT=folder ENCODER=folder; ARGS="--port 8000"
	@test -n "$(CHECKPOINT)$$RT1_CHECKPOINT" -a -n "$(ENCODER)$$RT1_ENCODER" || { echo "CHECKPOINT or ENCODER is not set; run:" \
	  "make policy-rt1 CHECKPOINT=folder ENCODER=folder (SavedModels of RT-1-X and of its text encoder); see docs/how-to/policies.md"; exit 2; }
	@$(BIN)/python scripts/make_environment.py policy-rt1
	.tools/policy-rt1-env/bin/python src/roboxim_policies/servers/rt1.py $(if $(CHECKPOINT),--checkpoint "$(CHECKPOINT)") \
	  $(if $(ENCODER),--encoder "$(ENCODER)") $(ARGS)

zero-shot: setup ## evaluate Octo, RT-1-X and OpenVLA (thesis 5.1), starting their servers; see docs/how-to/compare_policies.md; ARGS="--help"
	@$(BIN)/python scripts/zero_shot.py $(ARGS)

photo: setup ## install Blender (GPL) in its own environment, for roboxim rerender --renderer photo
	@$(BIN)/python scripts/make_environment.py photo

scale: setup ## add Ray, S3 and a stand-in for S3 to .venv, for --executor ray, --store and their tests
	@$(BIN)/python scripts/add_packages.py scale

robot-visuals: setup ## rebuild the robots' URDFs, SRDFs and meshes from the wheels that they come from
	@$(BIN)/python scripts/add_packages.py robots
	$(BIN)/python config/robots/panda/derive.py
	$(BIN)/python config/robots/ur5/derive.py
	for recipe in config/grippers/*/recipe.yaml; do $(BIN)/roboxim robot gripper $$recipe --out config || exit 1; done
	$(BIN)/python config/robots/widowx_ai/derive.py
	$(BIN)/python config/robots/so101/derive.py
	for recipe in config/robots/*/recipe.yaml; do $(BIN)/roboxim robot new $$recipe --out config || exit 1; done

release: setup ## build the distributions into dist/, install and run them in empty environments; ARGS="--python 3.12"
	@.venv/bin/python scripts/make_environment.py release
	@.venv/bin/python scripts/release.py $(ARGS)

try-lerobot: setup ## evaluate with the genuine lerobot in an empty environment of Python 3.12 (6 GB), with wheels alone
	@.venv/bin/python scripts/make_environment.py release
	@.venv/bin/python scripts/try_lerobot.py

lock: setup ## rebuild the locks in requirements/ from the pyproject.toml files
	@$(BIN)/python scripts/lock.py $(ARGS)

clean: ## remove builds and caches
	rm -rf build dist install log site .pytest_cache .mypy_cache .ruff_cache .hypothesis .tools/build .tools/colcon
	find src tests scripts benchmarks -name __pycache__ -type d -prune -exec rm -rf {} + 2>/dev/null || true

clean-all: clean ## remove the whole set-up too
	rm -rf .venv .tools

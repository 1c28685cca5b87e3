# One command for each habit. `make demo` and `make test` set everything up by themselves.
PYTHON ?= python3
BIN := .venv/bin
# The environment's bytecode is its own. Without it each of a hundred processes compiles every module again.
export PYTHONDONTWRITEBYTECODE :=
# The CDK's library runs on the environment's Node: the machine may have none, or an old one.
export JSII_NODE := $(CURDIR)/$(BIN)/node
# cdk.json runs `python app.py`.
bootstrap preflight deploy diff destroy: export PATH := $(CURDIR)/$(BIN):$(PATH)

.PHONY: help demo up down up-service up-password test test-all test-heavy test-fast test-oldest mutants check setup prove-mixed prove-ros2 prove-recorder prove-video prove-lerobot wheels wheelhouse release bench screenshots verify-aws docs-parts docs docs-serve layer bootstrap preflight deploy diff destroy lock clean

help: ## show this
	@grep -hE '^[a-z0-9-]+:.*## ' Makefile | sed -E 's/^([a-z0-9-]+):.*## /\1\t/' | expand -t 14

setup: ## set up .venv, node_modules and build/, nothing outside this folder
	@$(PYTHON) scripts/setup.py

demo: setup ## drive a car through the embedded cloud: DURATION=20 BAG=drive.bag FAULTS=flat_tyre:strong ROS2=1 LIVE=pubnub REPORT=report.json PORT=8080
	@$(BIN)/python -m local.demo $(if $(DURATION),--duration $(DURATION)) $(if $(BAG),--bag "$(BAG)") \
		$(if $(FAULTS),--faults "$(FAULTS)") $(if $(REPORT),--report "$(REPORT)") $(if $(PORT),--port $(PORT)) \
		$(if $(LIVE),--live $(LIVE)) $(if $(ROS2),--ros2)

# The options of the cloud that is kept.
STATE_OPTION = $(if $(STATE),--state "$(STATE)")
UP_OPTIONS = $(STATE_OPTION) $(if $(LISTEN),--listen "$(LISTEN)") $(if $(PAGE),--page "$(PAGE)") $(if $(POWER_CUT),--power-cut $(POWER_CUT)) $(if $(PORTS),--ports "$(PORTS)")

up: setup ## run a cloud of your own that is kept, until Ctrl-C: STATE=folder LISTEN=address,name PAGE=address,name POWER_CUT=1 PORTS=any
	@exec $(BIN)/python -m local.up.run $(UP_OPTIONS)

down: ## stop the cloud of `make up`, which is kept: STATE=folder
	@$(BIN)/python -m local.up.commands down $(STATE_OPTION)

up-service: setup ## let systemd run `make up`, also after a reboot; options as for up, REMOVE=1
	@$(BIN)/python -m local.up.service $(UP_OPTIONS) $(if $(REMOVE),--remove)

up-password: setup ## set the password of the page that PAGE= opens: STATE=folder
	@$(BIN)/python -m local.up.commands password $(STATE_OPTION)

PYTEST = $(BIN)/python -m pytest --numprocesses $(or $(WORKERS),4) --dist loadscope --no-loadscope-reorder --durations 20

test: setup ## run every test but the heaviest: REQUIRE_ALL=1 makes a skip a failure, WORKERS=4 run side by side
	@$(PYTEST) -m "not heavy"

test-heavy: setup ## run the scenarios that take minutes: options as for test
	@$(PYTEST) -m heavy

test-all: setup ## run every test, as CI does: options as for test, AGAIN=1 runs up to 3 that failed once more, alone
	@$(if $(AGAIN),$(BIN)/python scripts/again.py) $(PYTEST)

test-fast: setup ## run the unit tests that need no emulator, browser or ROS: while you work, WORKERS=2
	@$(BIN)/python -m pytest tests/unit --numprocesses $(or $(WORKERS),2) --dist loadscope --no-loadscope-reorder \
		-m "not slow" --hypothesis-profile fast

test-oldest: setup ## run the robot's tests on its oldest Python, 3.8, which ROS Noetic has: OLDEST=/path/to/python3.8
	@$(PYTHON) scripts/setup.py --oldest $(or $(OLDEST),any)
	@build/oldest/bin/python -m pytest -W "ignore:Python 3.8 is no longer supported" \
		tests/device tests/unit/agent tests/unit/contract

mutants: setup ## count how many of 300 fixed small faults the fast unit tests notice, in an hour
	@$(BIN)/python scripts/mutants.py run

check: setup ## run the linters, the type checkers, the links of docs/ and its generated parts, and cfn-lint, cdk-nag and checkov over the stacks
	@$(PYTHON) scripts/setup.py --checkov
	@$(BIN)/python -m scripts.docs_parts --check
	@$(BIN)/ruff check . && $(BIN)/ruff format --check . && $(BIN)/mypy app.py contract analysis scripts device functions stacks station local testkit bench verify docs/examples && $(BIN)/lint-imports --no-cache --no-logo && PATH="$(CURDIR)/$(BIN):$$PATH" npm run --silent check
	@$(MAKE) --no-print-directory docs
	@PATH="$(CURDIR)/$(BIN):$$PATH" $(BIN)/python scripts/check_stacks.py --checkov build/checkov/bin/checkov

wheels: setup ## build the packages into dist/: wheels and sdists of contract, agent, analysis and station
	@$(BIN)/python -m scripts.release build

ARCH = aarch64 x86_64

wheelhouse: setup ## build them, and for robots without a network an archive with all that the agent needs: ARCH=aarch64
	@$(BIN)/python -m scripts.release build --wheelhouse $(ARCH)

release: setup ## build, check, install and try the packages of a clean checkout: WHEELHOUSE=1 ARCH=aarch64, TAG=1 tags it here
	@$(BIN)/python -m scripts.release release $(if $(WHEELHOUSE),--wheelhouse $(ARCH)) $(if $(TAG),--tag)

prove-mixed: setup ## drive a robot of every shape of message beside rosbag record: DURATION=300
	@IORT_MIXED_S=$(or $(DURATION),300) $(BIN)/python -m pytest -rA tests/ros/mixed/test_mixed_robot.py

prove-ros2: setup ## drive a robot of ROS 2 beside ros2 bag record: DURATION=60 REPORT=report.json, RMW_IMPLEMENTATION as for ROS 2
	@IORT_ROS2_S=$(or $(DURATION),60) IORT_ROS2_REPORT=$(or $(REPORT),build/prove-ros2.json) \
		$(BIN)/python -m pytest -rA tests/ros2/proof

prove-recorder: setup ## prove that incidents are complete, in each ROS that is here: DURATION=60, 600 for five minutes without a broker
	@IORT_RECORDER_S=$(or $(DURATION),60) $(BIN)/python -m pytest -rA tests/ros/recorder

prove-video: setup ## prove what a driver saw, in Chromium and aiortc, on bad networks too: DURATION=60, 600 for fifty tries of each failure, REPORT=report.json
	@IORT_VIDEO_S=$(or $(DURATION),60) IORT_VIDEO_REPORT=$(or $(REPORT),build/prove-video.json) \
		$(BIN)/python -m pytest -rA tests/video/test_proof.py

prove-lerobot: setup ## let LeRobot itself read a dataset that `iort export` wrote: it installs 8 GB into build/
	@$(PYTHON) -m venv build/lerobot && build/lerobot/bin/pip install --quiet lerobot==0.4.4
	@IORT_LEROBOT=$(CURDIR)/build/lerobot/bin/python $(BIN)/python -m pytest -rA tests/unit/station/data/test_lerobot.py

# The options of the bench's sections: `python -m bench.run --help` tells whose.
BENCH_OPTIONS := CARS DURATION KILLS MEGABYTES MESSAGES NEW OLD PART PICTURES PRESSES QUICK RATE ROBOTS ROUNDS SECONDS SEED SOAK TRIES

bench: setup ## measure every table of the thesis, or others: ONLY=query,outage or agent, drive, fleet ..., TARGET=aws OUT=docs/bench
	@OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 $(BIN)/python -m bench.run $(if $(ONLY),--only $(ONLY)) \
		$(foreach name,$(BENCH_OPTIONS),$(if $($(name)),--set "$(name)=$($(name))")) $(if $(TARGET),--target $(TARGET)) \
		$(if $(YES),--yes) $(if $(OUT),--out $(OUT)) $(if $(NAMESPACE),--namespace $(NAMESPACE))

screenshots: setup ## take the pictures of docs/images anew: ONLY=video
	@$(BIN)/python -m bench.screenshots $(ONLY)

verify-aws: layer ## ask your AWS account what the design rests on: ONLY=rules,files YES=1 KEEP=1 BY=name
	@$(BIN)/python -m verify.run $(if $(ONLY),--only $(ONLY)) $(if $(TARGET),--target $(TARGET)) \
		$(if $(YES),--yes) $(if $(KEEP),--keep) $(if $(BY),--by "$(BY)") $(if $(OUT),--out $(OUT))

docs-parts: setup ## fill the generated parts of README.md and docs/ again
	@$(BIN)/python -m scripts.docs_parts

docs: ## build the documentation site into build/site; a broken link fails it
	@$(PYTHON) scripts/setup.py --docs
	@$(MKDOCS) build --strict --site-dir build/site

docs-serve: ## serve the documentation site on this machine, and follow what you write: PORT=8000
	@$(PYTHON) scripts/setup.py --docs
	@$(MKDOCS) serve --dev-addr localhost:$(or $(PORT),8000)

layer: ## build the functions' layers for AWS
	@$(PYTHON) scripts/setup.py --layer lambda

# Its warning is about mkdocs 2, which requirements/docs.txt excludes.
MKDOCS := NO_MKDOCS_2_WARNING=1 build/mkdocs/bin/mkdocs
CDK := $(BIN)/node node_modules/aws-cdk/bin/cdk

bootstrap: layer ## prepare an AWS account and region for the CDK, once
	@$(CDK) bootstrap

preflight: layer ## ask your AWS account what would make a deploy fail, and change nothing; ARGS as for deploy
	@$(BIN)/python -m verify.preflight $(ARGS)

deploy: layer ## deploy to the AWS account of your credentials: ARGS="-c key=value", SKIP_PREFLIGHT=1
	@derived=$$($(BIN)/python -m verify.preflight --derive $(if $(SKIP_PREFLIGHT),--unchecked) $(ARGS)) && \
		$(CDK) deploy --all $$derived $(ARGS)

diff: layer ## what a deploy would change, resource by resource
	@derived=$$($(BIN)/python -m verify.preflight --derive --unchecked $(ARGS)) && $(CDK) diff $$derived $(ARGS)

destroy: layer ## remove everything from it again, the data included
	@derived=$$($(BIN)/python -m verify.preflight --derive --unchecked $(ARGS)) && \
		$(BIN)/python scripts/destroy.py $(CDK) destroy --all $$derived $(ARGS)

lock: setup ## compile requirements/*.in to the locked *.txt
	@$(BIN)/uv pip compile --quiet --universal --generate-hashes --no-emit-index-url --python-version 3.10 \
		requirements/dev.in -o requirements/dev.txt
	@$(BIN)/uv pip compile --quiet --universal --generate-hashes --no-emit-index-url --python-version 3.10 \
		-c requirements/dev.txt requirements/layer.in -o requirements/layer.txt
	@$(BIN)/uv pip compile --quiet --universal --generate-hashes --no-emit-index-url --python-version 3.10 \
		-c requirements/dev.txt requirements/analysis-layer.in -o requirements/analysis-layer.txt
	@$(BIN)/uv pip compile --quiet --universal --generate-hashes --no-emit-index-url --python-version 3.10 \
		-c requirements/dev.txt requirements/build.in -o requirements/build.txt
	@$(BIN)/uv pip compile --quiet --universal --generate-hashes --no-emit-index-url --python-version 3.10 \
		requirements/checkov.in -o requirements/checkov.txt
	@$(BIN)/uv pip compile --quiet --universal --generate-hashes --no-emit-index-url --python-version 3.10 \
		requirements/docs.in -o requirements/docs.txt
	@$(BIN)/uv pip compile --quiet --universal --generate-hashes --no-emit-index-url --python-version 3.8.10 \
		--no-emit-package iort-agent --no-emit-package iort-contract requirements/robot.in -o requirements/robot.txt
	@$(BIN)/uv pip compile --quiet --generate-hashes --no-emit-index-url --python-version 3.8.10 \
		--no-emit-package iort-agent --no-emit-package iort-contract -c requirements/robot.txt requirements/oldest.in \
		-o requirements/oldest.txt

clean: ## remove what was made
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
	rm -rf .venv node_modules build dist cdk.out */*.egg-info */build station/iort_station/page/built .mypy_cache .ruff_cache .pytest_cache .hypothesis

# The verbs people and CI use. Every verb does its own set-up, once.
SHELL := /bin/bash
export PYO3_PYTHON := $(CURDIR)/.venv/bin/python
CARGO ?= cargo
TASK ?= hammer
BUNDLE ?= models/bundles/$(TASK)
EPISODES ?= 2
SEED ?= 1
OUT ?= runs/demo
PRETRAINED ?= models/small
DEMONSTRATIONS ?= 50
DEMONSTRATOR ?= pushed
LOOKS ?= plain
LEARNT ?= runs/learn/$(if $(ROBOT),$(ROBOT)-$(STATE),$(TASK))
ROBOT ?=
STATE ?= joints
BIN = $${CARGO_TARGET_DIR:-target}/release

.PHONY: help demo learn test lint install-capi clean

help: ## What there is
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 10

demo: ## A trained policy (TASK=hammer) over shared memory: summary and films in runs/demo
	@scripts/setup demo
	$(CARGO) build --release --locked -p rcwm-simulator -p rcwm-runtime -p rcwm-lab
	@scripts/demo "$(BUNDLE)" "$(TASK)" "$(EPISODES)" "$(OUT)" "$(SEED)"

learn: ## A new task (TASK=coffee-pull), or a robot (ROBOT=panda-lift), from demonstrations, deployed and scored: all in runs/learn
	@scripts/setup demo
	$(CARGO) build --release --locked -p rcwm-simulator -p rcwm-runtime -p rcwm-lab -p rcwm-trainer
ifneq ($(ROBOT),)
	@scripts/setup robosuite
	@scripts/learn-robot "$(ROBOT)" "$(LEARNT)" "$(if $(filter file,$(origin DEMONSTRATIONS)),100,$(DEMONSTRATIONS))" 50 "$(STATE)"
else
	@scripts/learn "$(TASK)" "$(PRETRAINED)" "$(LEARNT)" "$(DEMONSTRATIONS)" 50 "$(DEMONSTRATOR)" "$(LOOKS)"
endif

test: ## Everything that can be tested on one machine
	@scripts/setup test
	$(CARGO) build --release --locked --workspace --lib --bins --examples
	ORT_DYLIB_PATH="$${ORT_DYLIB_PATH:-$$(scripts/onnxruntime-library)}" $(CARGO) test --release --locked --workspace

lint: ## Formatting, clippy with warnings denied, licences (where cargo-deny is installed)
	@scripts/setup demo
	$(CARGO) fmt --all --check
	$(CARGO) clippy --release --locked --workspace --all-targets -- -D warnings
	@if $(CARGO) deny --version >/dev/null 2>&1; then $(CARGO) deny check bans licenses sources; \
	else echo "lint: cargo-deny is not installed, licences were not checked (cargo install cargo-deny)"; fi

install-capi: ## librcwm for C and C++: headers, libraries, pkg-config and CMake files under PREFIX
	@scripts/install-capi "$(or $(PREFIX),$(error name a folder: make install-capi PREFIX=$$HOME/.local))"

clean: ## Remove what was built and installed here
	rm -rf target .venv runs

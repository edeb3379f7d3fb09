#!/usr/bin/env bash
# The attached steps of all repositories under the oldest torch: .ci/older_torch.sh [PYTHON [FILE.npz]], of 3.9 to 3.11.
# torch 2.0.1 of PyPI brings 1.6 GB of CUDA 11 libraries and does not load without them. FILE.npz is what
# `python .ci/attached_steps.py FILE.npz` wrote in another environment; steps have to end there to within rounding.
set -euo pipefail
cd "$(dirname "$0")/.."
other=${2:+$(realpath "$2")}
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT

"${1:-python3.11}" -m venv "$work/venv"
"$work/venv/bin/pip" install --quiet torch==2.0.1 ".[older]" pytest hypothesis
cp -r tests docs .ci/attached_steps.py "$work"
cd "$work"
# Without the settings of this project's pytest, which need plugins; tests and docs lie outside of the checkout.
PYTHONPATH="$work/tests" "$work/venv/bin/python" -m pytest -q -c /dev/null --rootdir "$work" -p no:cacheprovider \
    tests/attach/test_every_repository.py tests/attach/test_probe.py tests/attach/test_attach_traps.py
PYTHONPATH="$work/tests" "$work/venv/bin/python" attached_steps.py steps.npz $other

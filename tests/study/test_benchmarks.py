"""The table of benchmarks: each entry leads to its settings and to what runs them."""

from __future__ import annotations

import importlib
import subprocess
import sys
from pathlib import Path

import pytest

from d2_plugin.settings import Settings, declared
from d2_plugin.study.bench import BENCHMARKS


@pytest.mark.parametrize("name", BENCHMARKS)
def test_each_benchmark_has_settings_with_help_and_something_that_runs_them(name: str) -> None:
    module = importlib.import_module(BENCHMARKS[name].module)
    settings = getattr(module, BENCHMARKS[name].settings)
    assert issubclass(settings, Settings)
    assert all(setting.help for setting in declared(settings))
    assert settings().output != Path()
    assert callable(module.run)


def test_the_table_is_read_without_importing_torch() -> None:
    code = "import sys, d2_plugin.study.bench; print('torch' in sys.modules)"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "False"

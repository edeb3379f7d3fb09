"""Commands that study/ serves: a module with a class of settings and `run(settings)`, which returns what to print."""

from __future__ import annotations

import importlib
import inspect

from d2_plugin.commands.arguments.form import Form


def study_form(command: str, module_name: str, settings: str) -> Form:
    """The form of a module of study/: its docstring is the help, the class named `settings` what it takes."""
    module = importlib.import_module(module_name)
    about = inspect.cleandoc(module.__doc__ or "")
    if not hasattr(module, "run"):  # TEMPORARY: argparse in study/, until it has `run`. Delete these two lines then.
        return Form(command, about, (), lambda given: None, words=module.main)
    return Form.of(command, about, getattr(module, settings), module.run)

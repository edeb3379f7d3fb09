"""Commands that study/ serves: a module with a class of settings and `run(settings)`, which returns what to print."""

from __future__ import annotations

import importlib
import inspect

from d2_plugin.commands.arguments.form import Form


def study_form(command: str, module_name: str, settings: str) -> Form:
    """The form of a module of study/: its docstring is the help, the class named `settings` what it takes."""
    module = importlib.import_module(module_name)
    about = inspect.cleandoc(module.__doc__ or "")
    return Form.of(command, about, getattr(module, settings), module.run)

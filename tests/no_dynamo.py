"""Imported first, it spares a small process two seconds: torch's optimizers import a compiler that none here uses."""

from __future__ import annotations

import sys
from types import ModuleType

import torch

absent = ModuleType("torch._dynamo")
absent.disable = lambda function, *_, **__: function
absent.graph_break = lambda *_, **__: None
sys.modules["torch._dynamo"] = torch._dynamo = absent

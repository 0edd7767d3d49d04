"""Every operator is one node of a compiled graph: no break in it, and the same bits."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from compile_operators import CASES


@pytest.fixture(scope="module")
def errors():
    script = Path(__file__).with_name("compile_operators.py")
    run = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, timeout=280)
    lines = [json.loads(line) for line in run.stdout.splitlines()]
    assert len(lines) == len(CASES), run.stderr
    return {line["operator"]: line["error"] for line in lines}


@pytest.mark.parametrize("name", [case.__name__ for case in CASES])
def test_an_operator_compiles_without_a_graph_break_forward_and_backward(name, errors):
    assert not errors[name], errors[name]

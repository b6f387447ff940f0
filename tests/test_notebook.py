"""The notebook runs from its first cell to its last."""

from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

from tests.tlq.policies import trained

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOK = ROOT / "notebooks" / "rollout.ipynb"


def shipped_policy(tmp_path):
    """A policy of this repository, or an untrained one."""
    shipped = sorted((ROOT / "policies").glob("*.npz"))
    return shipped[0] if shipped else trained().export(tmp_path / "policy.npz")


def test_notebook_holds_no_results():
    cells = nbformat.read(NOTEBOOK, as_version=4).cells
    assert not any(cell.get("outputs") or cell.get("execution_count") for cell in cells)


@pytest.mark.slow
def test_notebook_runs(tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(ROOT))  # the kernel's, where tlq isn't installed
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    (parameters,) = [cell for cell in notebook.cells if "parameters" in cell.metadata.get("tags", [])]
    parameters.source += f"\npolicy_name = {str(shipped_policy(tmp_path))!r}\nseconds = 0.2"
    NotebookClient(notebook, timeout=900, resources={"metadata": {"path": NOTEBOOK.parent}}).execute()
    printed = "".join(o.get("text", "") for c in notebook.cells for o in c.get("outputs", []))
    shown = [o.data for c in notebook.cells for o in c.get("outputs", []) if "data" in o]
    assert " m in 0." in printed
    assert sum("image/png" in data for data in shown) == 2

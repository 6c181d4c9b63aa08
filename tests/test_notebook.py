"""The notebook runs from its first cell to its last, and the outputs that it keeps are its own."""

from __future__ import annotations

import os
import sys
from itertools import groupby
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

NOTEBOOK = Path(__file__).parent.parent / "examples" / "racing.ipynb"
MOST_CELLS = 10
PATIENCE = 600  # [s] for a cell, on a busy machine


def outputs(notebook):
    """What each cell has put out, by kind; a slow machine puts text out in several pieces."""
    return [
        [
            kind
            for kind, _ in groupby(
                (output.output_type, sorted(output.get("data", {}))) for output in cell.outputs
            )
        ]
        for cell in notebook.cells
        if cell.cell_type == "code"
    ]


@pytest.mark.rare
@pytest.mark.usefixtures("game")
def test_the_notebook_puts_out_what_it_keeps(tmp_path, monkeypatch):
    """A cell with an error would stop it."""
    monkeypatch.setenv("PATH", f"{Path(sys.executable).parent}:{os.environ['PATH']}")
    kept = nbformat.read(NOTEBOOK, as_version=4)
    run = nbformat.read(NOTEBOOK, as_version=4)
    for cell in run.cells:
        if cell.cell_type == "code":
            cell.outputs = []
    resources = {"metadata": {"path": str(tmp_path)}}
    NotebookClient(run, timeout=PATIENCE, resources=resources).execute()
    assert outputs(run) == outputs(kept)
    laps = [cell.outputs[0].data["text/plain"] for notebook in (run, kept)
            for cell in notebook.cells if "race.lap_times" in cell.source]  # fmt: skip
    assert laps[0] == laps[1]
    assert (tmp_path / "lap.mp4").stat().st_size > 100_000
    assert (tmp_path / "laps.html").read_text().startswith("<!DOCTYPE html>")


def test_the_notebook_is_short_and_shows_a_video_and_a_page():
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    assert len(notebook.cells) <= MOST_CELLS
    text = NOTEBOOK.read_text("utf-8")
    assert "data:video/mp4;base64," in text
    assert "srcdoc=" in text

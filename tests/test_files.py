"""Files that are written whole or not at all."""

from __future__ import annotations

import pytest

from sb3_torcs.errors import OutputNotWritable
from sb3_torcs.files import atomic_file


def test_a_symbolic_link_stays_and_its_target_is_written(tmp_path):
    target, link = tmp_path / "data" / "lap.csv", tmp_path / "lap.csv"
    target.parent.mkdir()
    target.write_text("old")
    link.symlink_to(target)
    with atomic_file(link) as path:
        path.write_text("new")
    assert link.is_symlink()
    assert target.read_text() == "new"


def test_a_link_to_nowhere_is_refused(tmp_path):
    link = tmp_path / "lap.csv"
    link.symlink_to(tmp_path / "gone" / "lap.csv")
    with pytest.raises(OutputNotWritable, match="No such file"), atomic_file(link):
        raise AssertionError("it is written nevertheless")

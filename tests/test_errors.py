"""How complaints end."""

from __future__ import annotations

import pytest

from sb3_torcs.errors import near_miss


@pytest.mark.parametrize(
    ("name", "advice", "ending"),
    [
        ("aalbrog", "it has aalborg", "; did you mean 'aalborg'? it has aalborg"),
        ("aalbrog", "", "; did you mean 'aalborg'?"),
        ("AALBORG", "", "; did you mean 'aalborg'?"),
        ("x", "it has aalborg", "; it has aalborg"),
        ("x", "", ""),
    ],
)
def test_a_complaint_ends_with_the_near_miss_and_the_advice(name, advice, ending):
    assert near_miss(name, ["aalborg", "forza"], advice) == ending

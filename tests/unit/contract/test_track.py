"""A track's CSV file: as the usual tools write it, and what is wrong with others."""

from __future__ import annotations

import pytest

from iort_contract.limits import ContractError
from iort_contract.track import Track, parse_track

SQUARE = Track((0.0, 4.0, 4.0, 0.0), (0.0, 0.0, 3.0, 3.0), (1.1,) * 4, (0.9,) * 4)


@pytest.mark.parametrize(
    "text",
    [
        "# x_m, y_m, w_tr_right_m, w_tr_left_m\n0.0, 0.0, 1.1, 0.9\n4,0,1.1,0.9\n4,3,1.1,0.9\n0,3,1.1,0.9\n",
        "x_m;y_m;w_right_m;w_left_m\r\n0;0;1.1;0.9\r\n4;0;1.1;0.9\r\n4;3;1.1;0.9\r\n0;3;1.1;0.9\r\n",
        "0,0,1.1,0.9\n4,0,1.1,0.9\n\n4,0,1.1,0.9\n4,3,1.1,0.9\n0,3,1.1,0.9\n0,0,1.1,0.9",
        SQUARE.csv(),
    ],
    ids=["F1TENTH and TU Munich", "names and semicolons", "doubled points and a closed line", "our own"],
)
def test_the_usual_files_are_read(text: str) -> None:
    assert parse_track(text) == SQUARE


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "4 to 20000 points, got 0"),
        ("0,0,1,1\n1,0,1,1\n0,0,1,1\n", "4 to 20000 points, got 2"),
        ("0,0,1,1\n1,0,1\n", "line 2 must be the four numbers x_m, y_m, w_right_m, w_left_m, got '1,0,1'"),
        ("s;x;y;psi;kappa;vx;ax\n0;1;2;3;4;5;6\n", "line 2 must be the four numbers"),
        ("0,0,1,1\nx,0,1,1\n", "line 2 must be the four numbers"),
        ("0,0,1,1\nnan,0,1,1\n", "line 2 must be the four numbers"),
        ("0,0,1,1\ninf,0,1,1\n", "line 2 must be within 100000 m"),
        ("0,0,1,-1\n", "line 1: widths must be over 0 m"),
    ],
)
def test_a_wrong_file_is_refused_with_its_line(text: str, said: str) -> None:
    with pytest.raises(ContractError, match=said):
        parse_track(text)

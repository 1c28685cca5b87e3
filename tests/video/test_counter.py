"""The reader of the number in a picture that a page runs: it reads what the agent's own reader reads."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

from iort_contract.counter import read_counter
from testkit.video import COUNTER_JS
from tests.unit.contract.test_counter import drawn

SIZE = 96


def test_a_page_reads_the_same_numbers() -> None:
    numbers = [0, 1, 255, 65_536, 123_456_789, 2**31, 2**32 - 1]
    pictures = [drawn(number, SIZE, SIZE) for number in numbers]
    pictures += [drawn(7, SIZE, SIZE, white=128), [[255] * SIZE] * SIZE, drawn(7, SIZE, SIZE)[::-1]]
    images = [
        {
            "width": SIZE,
            "height": SIZE,
            "data": [v for row in rows for level in row for v in (level,) * 3 + (255,)],
        }
        for rows in pictures
    ]
    program = f"""
        {COUNTER_JS}
        let text = "";
        process.stdin.on("data", (part) => {{ text += part; }});
        process.stdin.on("end", () => console.log(JSON.stringify(JSON.parse(text).map(readCounter))));
    """
    node = Path(sys.executable).with_name("node")
    out = subprocess.run(
        [node, "-e", program], input=json.dumps(images), capture_output=True, text=True, check=True
    )
    expected = [read_counter(lambda x, y, rows=rows: rows[y][x], SIZE, SIZE) for rows in pictures]  # type: ignore[misc]  # a default binds it
    assert json.loads(out.stdout) == expected
    assert expected == [*numbers, None, None, None]

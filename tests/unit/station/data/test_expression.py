"""The language of conditions: its results, its errors, and the agreement of both evaluators."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from iort_contract import expression
from iort_contract.expression import ExpressionError, MismatchError, parse
from iort_station.data import conditions
from iort_station.errors import StationError

SAMPLES = {
    "speed": [0, 1.5, -2, None],
    "fault_code": [0, 1, 0, 2],
    "name": ["a", "b", None, "a"],
    "on": [True, False, True, None],
    "pose.x": [1, 2, 3, 4],
    "covariance.0": [5, 6, 7, 8],
}


def column(values):
    plain = all(value is None or type(value) in (int, float) for value in values)
    array = np.empty(len(values), dtype=object)
    array[:] = values
    return array.astype(float) if plain else array


def both(text, samples=SAMPLES):
    node, n = parse(text), len(next(iter(samples.values())))
    lists = expression.holds(node, samples, n)
    arrays = conditions.holds(node, {name: column(values) for name, values in samples.items()}, n)
    assert arrays.tolist() == lists
    return lists


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("speed == None", [0, 0, 0, 1]),
        ("speed != None", [1, 1, 1, 0]),
        ("None != name", [1, 1, 0, 1]),
        ("not name == None and name != 'a'", [0, 1, 0, 0]),
        ("speed in (0, None)", [1, 0, 0, 1]),
        ("on == None", [0, 0, 0, 1]),
        ("on is not None", [1, 1, 1, 0]),
        ("missing != None", [0, 0, 0, 0]),
        ("missing == 'a' or missing == 1", [0, 0, 0, 0]),
        ("speed > 1.2", [0, 1, 0, 0]),
        ("abs(speed) >= 1.5", [0, 1, 1, 0]),
        ("-2 <= speed < 1", [1, 0, 1, 0]),
        ("speed != 0", [0, 1, 1, 0]),
        ("not speed > 1.2", [1, 0, 1, 1]),
        ("speed is None", [0, 0, 0, 1]),
        ("speed is not None and fault_code == 0", [1, 0, 1, 0]),
        ("fault_code in (1, 2)", [0, 1, 0, 1]),
        ("fault_code not in [1, 2]", [1, 0, 1, 0]),
        ("speed", [0, 1, 1, 0]),
        ("on", [1, 0, 1, 0]),
        ("name == 'a'", [1, 0, 0, 1]),
        ("name != 'a'", [0, 1, 0, 0]),
        ("pose.x * 2 + 1 > 6", [0, 0, 1, 1]),
        ("covariance[0] % 2 == 0", [0, 1, 0, 1]),
        ("1 / speed > 0", [0, 1, 0, 0]),
        ("speed / 0 is None", [1, 1, 1, 1]),
        ("missing > 0 or missing is None", [1, 1, 1, 1]),
        ("  speed > 0\n and fault_code == 1 ", [0, 1, 0, 0]),
    ],
)
def test_a_condition_selects_the_matching_samples(text, expected):
    assert both(text) == list(map(bool, expected))


@pytest.mark.parametrize(
    ("text", "position"),
    [
        ("speed >", 7),
        ("speed > 1 > {x}", 12),
        ("__import__('os').system('x') > 0", 0),
        ("speed > [1]", 8),
        ("speed ** 2 > 1", 0),
        ("speed > open('x')", 8),
        ("speed is 3", 9),
        ("speed in fault_code", 9),
        ("speed[name] > 1", 0),
        ("lambda: 1", 0),
        ("1e999 > speed", 0),
        ("", 0),
        ("'é' == name and f'{x}'", 16),
        # No field can meet these.
        ("speed > None", 8),
        ("speed + None > 1", 8),
        ("None", 0),
        ("speed + 1 > '3'", 0),
        ("fault_code == 0 and 2 == '2'", 20),
        ("speed * '2' > 3", 0),
        ("abs('x') > 3", 0),
        ("-'x' > 3", 0),
    ],
)
def test_an_invalid_condition_is_refused_with_its_position(text, position):
    with pytest.raises(ExpressionError) as refused:
        parse(text)
    assert refused.value.position == position
    assert str(refused.value).splitlines()[-1].index("^") == position + 2


@pytest.mark.parametrize("text", ["(" * 500 + "1" + ")" * 500, "not " * 200 + "x", "x" * 2000])
def test_deep_and_long_conditions_are_refused(text):
    with pytest.raises(ExpressionError):
        parse(text)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("speed > '3'", "cannot compare a number with a text: speed is a number, '3' is a text"),
        ("fault_code == 7 and speed != '3'", "speed is a number, '3' is a text"),
        ("speed in (1, '2')", "speed is a number, '2' is a text"),
        ("on == 'true'", "on is a number, 'true' is a text"),
        ("name == 3", "name is a text, 3 is a number"),
        ("name == fault_code", "name is a text, fault_code is a number"),
        ("mixed == 'a'", "mixed is a number or a text, 'a' is a text"),
        ("name + 1 > 2", "cannot calculate with a text: name is a text, 1 is a number"),
        ("not abs(name) > 2", "cannot calculate with a text: name is a text"),
    ],
)
def test_a_number_compared_with_a_text_is_an_error(text, said):
    samples = {**SAMPLES, "mixed": ["a", 1, None, None]}
    node = parse(text)
    with pytest.raises(MismatchError) as in_the_cloud:
        expression.holds(node, samples, 4)
    assert said in str(in_the_cloud.value)
    with pytest.raises(StationError) as here:
        conditions.holds(node, {name: column(values) for name, values in samples.items()}, 4)
    assert str(here.value) == f"the condition cannot be evaluated: {in_the_cloud.value}"


numbers = st.one_of(st.none(), st.integers(-5, 5), st.floats(-1e308, 1e308))
terms = st.recursive(
    st.sampled_from(["a", "b", "flag", "0", "1.5", "True"]),
    lambda part: st.one_of(
        st.tuples(part, st.sampled_from("+-*/%"), part).map(lambda t: f"({t[0]} {t[1]} {t[2]})"),
        part.map("abs({})".format),
        part.map("(-{})".format),
    ),
    max_leaves=6,
)
truths = st.recursive(
    st.one_of(
        terms,
        st.tuples(terms, st.sampled_from(["<", "<=", "==", "!=", ">", ">="]), terms).map(" ".join),
        terms.map("{} is None".format),
        terms.map("{} == None".format),
        terms.map("None != {}".format),
    ),
    lambda part: st.one_of(
        st.tuples(part, st.sampled_from(["and", "or"]), part).map(lambda t: f"({t[0]}) {t[1]} ({t[2]})"),
        part.map("not ({})".format),
    ),
    max_leaves=5,
)


words = st.sampled_from(["a", "b", "s", "t", "'x'", "1"])
over_texts = st.recursive(
    st.one_of(
        st.tuples(words, st.sampled_from(["<", "==", "!=", ">="]), words).map(" ".join),
        words.map("{} != None".format),
    ),
    lambda part: st.one_of(
        st.tuples(part, st.sampled_from(["and", "or"]), part).map(lambda t: f"({t[0]}) {t[1]} ({t[2]})"),
        part.map("not ({})".format),
    ),
    max_leaves=4,
)
maybe_texts = st.one_of(st.none(), st.sampled_from(["", "x", "y"]))


@given(over_texts, st.lists(st.tuples(numbers, numbers, maybe_texts, maybe_texts), min_size=1, max_size=4))
def test_lists_and_arrays_agree_on_errors(text, rows):
    samples = dict(zip("abst", map(list, zip(*rows, strict=True)), strict=True))
    try:
        node = parse(text)
        lists = expression.holds(node, samples, len(rows))
    except ExpressionError:
        return
    except MismatchError:
        with pytest.raises(StationError):
            conditions.holds(node, {name: column(values) for name, values in samples.items()}, len(rows))
        return
    arrays = conditions.holds(node, {name: column(values) for name, values in samples.items()}, len(rows))
    assert arrays.tolist() == lists


@given(truths, st.lists(st.tuples(numbers, numbers, st.booleans()), min_size=1, max_size=5))
def test_lists_and_arrays_agree(text, rows):
    a, b, flag = (list(values) for values in zip(*rows, strict=True))
    both(text, {"a": a, "b": b, "flag": flag})

# SPDX-License-Identifier: Apache-2.0
"""Reading JSON of a host that may be hostile."""

import json
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from structgstream.codec.segments.manifest import MOST, Fields, parse_object
from structgstream.errors import StreamError
from tests.support.properties import examples

JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=8,
)


def fields(**values: Any) -> Fields:
    return Fields(values, "it")


READERS: dict[str, Callable[[Fields], object]] = {
    "whole": lambda one: one.whole("x"),
    "wholes": lambda one: one.wholes("x", count=2),
    "number": lambda one: one.number("x"),
    "pair": lambda one: one.pair("x"),
    "text": lambda one: one.text("x", most=5),
    "flag": lambda one: one.flag("x"),
    "file": lambda one: one.file("x"),
    "sha256": lambda one: one.sha256("x"),
    "items": lambda one: one.items("x", most=2),
    "fields": lambda one: one.fields("x"),
}


def expected(kind: str, value: Any) -> bool:
    """Whether a value is of the kind, said in another way than the module says it."""
    number = type(value) in (int, float) and -1e15 <= value <= 1e15
    if kind in ("whole", "number"):
        return number and (kind == "number" or (value == round(value) and 0 <= value < 2**32))
    if kind == "wholes":
        return type(value) is list and len(value) == 2 and all(expected("whole", one) for one in value)
    if kind == "pair":
        one_or_two = type(value) is list and len(value) == 2 and all(expected("number", one) for one in value)
        return one_or_two and value[0] <= value[1]
    if kind == "items":
        return type(value) is list and len(value) <= 2 and all(type(one) is dict for one in value)
    return {
        "text": lambda: type(value) is str and len(value) <= 5 and value == value.encode(errors="replace").decode(),
        "flag": lambda: type(value) is bool,
        "fields": lambda: type(value) is dict,
    }[kind]()


@pytest.mark.parametrize("kind", sorted(set(READERS) - {"file", "sha256"}))
@given(value=JSON)
@examples(200)
def test_a_value_is_of_its_kind_or_refused_in_a_sentence(kind: str, value: Any) -> None:
    one = fields(x=value)
    if expected(kind, value):
        READERS[kind](one)
    else:
        with pytest.raises(StreamError, match=r"(?s)^it.* expected .*\.$"):
            READERS[kind](one)


@pytest.mark.parametrize("kind", sorted(READERS))
def test_what_is_missing_is_named(kind: str) -> None:
    with pytest.raises(StreamError, match=r"^it has no 'x'\.$"):
        READERS[kind](fields(y=1))


@pytest.mark.parametrize("text", ["-1" + "0" * 400, "1" + "0" * 400, "-1e400", "1e400", "true", '"1"', "null", "[1]"])
def test_numbers_of_any_length_are_refused_in_words(text: str) -> None:
    one = parse_object(f'{{"x": {text}}}'.encode(), "it", max_bytes=1000)
    for read in (lambda: one.number("x"), lambda: one.whole("x"), lambda: one.number("x", least=0.0)):
        with pytest.raises(StreamError, match=r"^it has 'x' .*; expected a (whole )?number from .* to "):
            read()


def test_bounds_belong_to_what_is_allowed() -> None:
    assert [fields(x=value).whole("x", least=3, most=5) for value in (3, 5)] == [3, 5]
    assert fields(x=3).number("x", least=3.0) == 3.0
    assert [fields(x=value).number("x") for value in (MOST, -MOST)] == [MOST, -MOST]
    for value in (2, 6):
        with pytest.raises(StreamError, match="a whole number from 3 to 5"):
            fields(x=value).whole("x", least=3, most=5)
    with pytest.raises(StreamError, match="a number from 3 to 1e\\+15"):
        fields(x=2).number("x", least=3.0)
    with pytest.raises(StreamError, match="1000000000000001"):
        fields(x=10**15 + 1).number("x")
    assert isinstance(fields(x=3).number("x"), float)


@pytest.mark.parametrize("text", ["\ud800", "a\udfffb"])
def test_halves_of_characters_are_no_text(text: str) -> None:
    """Nobody could print them; JSON writes them as an escape."""
    one = parse_object(json.dumps({"x": text}).encode(), "it", max_bytes=100)
    with pytest.raises(StreamError, match="expected a text") as found:
        one.text("x")
    str(found.value).encode()


def test_texts_have_a_length() -> None:
    assert fields(x="\U0001f600" * 5).text("x", most=5) == "\U0001f600" * 5
    with pytest.raises(StreamError, match="at most 5 characters"):
        fields(x="a" * 6).text("x", most=5)


@pytest.mark.parametrize("name", ["a", "a.b-c_9", "-", "A" * 128])
def test_plain_names(name: str) -> None:
    assert fields(file=name).file() == name


@pytest.mark.parametrize(
    "name", ["", ".a", "..", "a/b", "a\\b", "a b", "a\n", "A" * 129, "é", "http:x", "%2e", None, 1, ["a"]]
)
def test_names_that_lead_elsewhere(name: object) -> None:
    with pytest.raises(StreamError, match="plain name of a file"):
        fields(file=name).file()


@pytest.mark.parametrize("digest", ["0" * 63, "0" * 65, "A" * 64, "g" * 64, "0" * 63 + "\n", None, 0])
def test_what_is_no_hash(digest: object) -> None:
    with pytest.raises(StreamError, match="64 hex digits"):
        fields(sha256=digest).sha256()
    assert fields(sha256="0f" * 32).sha256() == "0f" * 32


def test_objects_within_objects_are_named_by_their_place() -> None:
    one = fields(list=[{"a": 1}, {"a": -1}], inner={"b": True})
    assert [entry.whole("a", least=-1) for entry in one.items("list", most=2)] == [1, -1]
    with pytest.raises(StreamError, match=r"^it, list\[1\] has 'a' -1"):
        one.items("list", most=2)[1].whole("a")
    with pytest.raises(StreamError, match=r"^it, inner has 'b' true"):
        one.fields("inner").whole("b")
    with pytest.raises(StreamError, match="a list of at most 1 objects"):
        one.items("list", most=1)
    with pytest.raises(StreamError, match=r"^it, inner is wrong\.$"):
        one.fields("inner").refuse("is wrong")


def test_null_is_there_and_nothing_is_not() -> None:
    assert fields(x=None).is_none("x")
    assert not fields(x=0).is_none("x")
    with pytest.raises(StreamError, match="has no 'x'"):
        fields().is_none("x")


@pytest.mark.parametrize(
    "data", [b"", b"{", b"\xff", b'{"a":}', b"1" * 5000, b"[" * 100_000, b'{"a":' * 5000, b"null", b"[]", b'"x"', b"1"]
)
def test_what_is_no_object(data: bytes) -> None:
    with pytest.raises(StreamError, match="^it is "):
        parse_object(data, "it", max_bytes=10**6)


def test_the_length_is_looked_at_first() -> None:
    assert parse_object(b'{"x":1}', "it", max_bytes=7).whole("x") == 1
    with pytest.raises(StreamError, match="it has 8 bytes; expected at most 7"):
        parse_object(b'{"x":1} ', "it", max_bytes=7)


@given(st.binary(max_size=40))
@examples(300)
def test_nothing_but_an_object_or_a_sentence_comes_out(data: bytes) -> None:
    try:
        parse_object(data, "it", max_bytes=30)
    except StreamError:
        return


def test_a_long_value_is_shown_by_its_beginning() -> None:
    with pytest.raises(StreamError) as found:
        fields(x=["y" * 10_000]).flag("x")
    assert len(str(found.value)) < 120
    assert "..." in str(found.value)
    with pytest.raises(StreamError, match=r"'x' \"yyy\";"):
        fields(x="yyy").flag("x")

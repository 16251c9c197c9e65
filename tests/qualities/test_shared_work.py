# SPDX-License-Identifier: Apache-2.0
"""A value that several ask for is computed once; what it is good for stands in ``test_recording``."""

from structgstream.qualities import Once


def test_who_asks_first_makes_it() -> None:
    once, made = Once[str](2), []

    def make(text: str) -> str:
        made.append(text)
        return text

    assert once.value(1, lambda: make("a")) == ("a", True)
    assert once.value(1, lambda: make("b")) == ("a", False)
    once.value(2, lambda: make("c"))
    once.value(3, lambda: make("d"))
    assert once.value(1, lambda: make("e")) == ("e", True), "only so many are kept"
    once.clear()
    assert once.value(3, lambda: make("f")) == ("f", True)
    assert made == ["a", "c", "d", "e", "f"]

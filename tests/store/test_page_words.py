"""The words of the pages without scripts: how many of what was found."""

import pytest

from sorvolo.store.pages.words import count_words


@pytest.mark.parametrize(("counts", "words"), [
    ({"bus": 2, "person": 1, "car": 0}, "2 buses, 1 person"),
    ({"person": 4, "car": 3}, "4 people, 3 cars"),
    ({"car": 0}, "nothing"),
])
def test_counts_are_given_in_english(counts: dict[str, int], words: str) -> None:
    assert count_words(counts) == words

"""Counts as people write them."""

import pytest

from sorvolo.survey.wording import counted, counted_list, most_first, plural


@pytest.mark.parametrize(
    ("count", "noun", "words"),
    [
        (1, "person", "1 person"),
        (4, "person", "4 people"),
        (2, "small object", "2 small objects"),
        (0, "car", "no cars"),
        (1234, "frame", "1,234 frames"),
        (2, "box", "2 boxes"),
        (3, "bus", "3 buses"),
        (2, "boundary", "2 boundaries"),
        (2, "day", "2 days"),
        (5, "missed person", "5 missed people"),
    ],
)
def test_a_count_has_its_plural(count: int, noun: str, words: str) -> None:
    assert counted(count, noun) == words


def test_a_list_of_counts() -> None:
    assert counted_list({"bus": 2, "person": 1, "car": 0}) == "2 buses, 1 person"
    assert counted_list({"person": 4, "car": 3, "small object": 0}) == "4 people, 3 cars"
    assert (
        counted_list({"person": 0}) == "nothing"
        and counted_list({}, none="none found") == "none found"
    )


def test_the_most_frequent_stand_first_and_equals_by_name_whatever_order_they_came_in() -> None:
    assert list(most_first(["person", "car", "boat", "boat"]).items()) == [
        ("boat", 2),
        ("car", 1),
        ("person", 1),
    ]
    assert (
        list(most_first(["car", "person"]))
        == list(most_first(["person", "car"]))
        == ["car", "person"]
    )
    assert most_first([]) == {}


def test_verbs_agree() -> None:
    assert (plural("is", 1), plural("is", 2), plural("was", 3)) == ("is", "are", "were")

"""The wording of pages, messages, docstrings and names stays plain English."""

import pytest

from tools.release.check_english import (
    Limits,
    check_module,
    check_page,
    find_all,
    is_lone_word,
    read_limits,
    select_violations,
)


def test_pages_messages_docstrings_and_names_are_plain_english():
    violations = select_violations(find_all(), read_limits())
    assert [f"{v.path}:{v.line}: {v.kind}: {v.text} {v.advice}" for v in violations] == []


@pytest.mark.parametrize("name", ["told", "_widened", "largely", "steepest", "beside"])
def test_lone_words_are_no_names(name):
    assert is_lone_word(name)


@pytest.mark.parametrize("name", ["speed", "apply", "is_told", "widen_bounds", "Reached", "digest"])
def test_nouns_verbs_and_phrases_are_names(name):
    assert not is_lone_word(name)


def test_a_page_is_searched_outside_code():
    page = "# Title\n\nWhat is lacking `what is told` is not told.\n\n```\nbeside\n```\n| at 1a2b3c4 | x |\n"
    kinds = [(finding.line, finding.kind) for finding in check_page("page.md", page)]
    assert kinds == [(3, "phrase"), (3, "phrase"), (8, "history")]


def test_a_long_sentence_is_found_and_a_list_of_short_ones_is_not():
    sentence = " ".join(["word"] * 33) + "."
    assert [f.kind for f in check_page("page.md", sentence)] == ["long"]
    assert not list(check_page("page.md", "One two. " * 20))


def test_docstrings_comments_and_messages_of_a_module_are_told_apart():
    module = '"""What it lacks."""\nx = 1  # free runs\ny = "the answer that comes back"\nz = "beside"\n'
    places = [(f.line, f.where) for f in check_module("m.py", module)]
    assert places == [(1, "docstring"), (3, "message"), (2, "docstring")]


def test_limits_hold_per_folder_and_allowed_passages_do_not_count():
    found = [*check_page("docs/a.md", "It lacks this. It is told."), *check_page("models/b.md", "beside")]
    assert len(select_violations(found, Limits(frozenset(), {}))) == 3
    limits = Limits(frozenset({("models/b.md", "beside")}), {("docs", "phrase", "page"): 2})
    assert select_violations(found, limits) == []

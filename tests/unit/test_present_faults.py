"""The one book of present faults."""

from __future__ import annotations

from graderd.hal.fault import EVENT_SHOWN_S, DeviceFault, PresentFaults


def test_a_state_holds_until_cleared_with_its_newest_detail_and_its_first_time() -> None:
    book = PresentFaults("rotation")
    assert book.set("no_reply", "a", 1.0)
    assert not book.set("no_reply", "b", 2.0)
    assert book.present(1e6) == (DeviceFault("rotation", "no_reply", "b", 1.0),)
    book.clear("no_reply", "never there")
    assert book.present(3.0) == ()
    assert book.set("no_reply", "c", 4.0)
    assert book.present(4.0)[0].since_s == 4.0


def test_an_event_is_shown_for_its_time_and_longer_where_it_is_told_again() -> None:
    book = PresentFaults("tilt")
    assert book.tell("restarted", "a", 10.0)
    assert book.names(10.0 + EVENT_SHOWN_S) == {"restarted"}
    assert book.names(10.01 + EVENT_SHOWN_S) == frozenset()
    assert not book.tell("restarted", "b", 10.9)
    assert book.present(11.5) == (DeviceFault("tilt", "restarted", "b", 10.0),)
    assert book.tell("restarted", "c", 20.0), "the one before was over"
    assert book.present(20.0)[0].since_s == 20.0
    book.tell("long", "", 20.0, shown_s=5.0)
    assert book.names(24.0) == {"long"}


def test_a_state_that_became_an_event_ends_as_one_and_the_other_way_round() -> None:
    book = PresentFaults("can")
    book.set("flood", "", 1.0)
    assert not book.tell("flood", "", 2.0)
    assert book.names(3.1) == frozenset()
    book.tell("flood", "", 4.0)
    book.set("flood", "", 4.5)
    assert book.names(60.0) == {"flood"}


def test_oldest_first() -> None:
    book = PresentFaults("can")
    book.set("b", "", 2.0)
    book.set("a", "", 1.0)
    assert [fault.condition for fault in book.present(3.0)] == ["a", "b"]


def test_a_group_is_replaced_and_the_others_are_left_alone() -> None:
    book = PresentFaults("camera")
    book.set("other", "", 1.0)
    book.keep_only({"x": "1"}, 2.0, among=frozenset({"x", "y"}))
    book.keep_only({"x": "2", "y": "3"}, 3.0, among=frozenset({"x", "y"}))
    assert [(f.condition, f.detail, f.since_s) for f in book.present(3.0)] == [
        ("other", "", 1.0), ("x", "2", 2.0), ("y", "3", 3.0),
    ]  # fmt: skip
    book.keep_only({}, 4.0, among=frozenset({"x", "y"}))
    assert book.names(4.0) == {"other"}
    book.keep_only({"z": ""}, 5.0)
    assert book.names(5.0) == {"z"}
    book.keep("z", False, "", 6.0)
    book.keep("w", True, "", 6.0)
    assert book.names(6.0) == {"w"}
    book.clear_all()
    assert book.names(6.0) == frozenset()


def test_what_a_reader_was_given_does_not_change_under_it() -> None:
    """One thread writes and another reads: nothing that is being read is changed in place."""
    book = PresentFaults("daemon")
    for n in range(50):
        book.set(f"c{n}", "", float(n))
    entries = book._entries
    before = dict(entries)
    book.set("more", "", 1.0)
    book.clear("c1")
    book.tell("c2", "new", 2.0)
    assert entries == before

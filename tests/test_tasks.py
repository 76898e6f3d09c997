"""Named work, and those who listen to it."""

import pytest

from dolens.tasks import listening, stage


def test_a_listener_hears_of_stages_and_of_their_parts():
    heard = []
    with listening(heard.append), stage("planning"), stage("rays"):
        pass
    with stage("nobody listens"):
        pass
    assert heard == [
        (("planning",), True),
        (("planning", "rays"), True),
        (("planning", "rays"), False),
        (("planning",), False),
    ]


def test_a_stage_that_fails_has_ended():
    heard = []
    with listening(heard.append):
        with pytest.raises(ZeroDivisionError), stage("division"):
            raise ZeroDivisionError
        with stage("next"):
            pass
    assert [(event.names, event.begins) for event in heard[1:]] == [
        (("division",), False),
        (("next",), True),
        (("next",), False),
    ]

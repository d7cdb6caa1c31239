"""The codec of the motion process: what goes in comes out, errors included; anything else is refused."""

from __future__ import annotations

import math
import struct
from dataclasses import fields

import numpy as np
import pytest

from docking import errors
from docking.errors import BadReply, Defect, DockingError, FollowingErrorTrip, LeaseLost
from docking.motion.messages import VERSION, decode, encode
from docking.types import AxisState, Feedback, Identity, MoveResult, StopTimes, Trace
from tests.support.planned_moves import a_plan, lab_site


def there_and_back(value):
    kind, number, payload = decode(encode("x", 7, value))
    assert (kind, number) == ("x", 7)
    return payload


@pytest.mark.parametrize(
    "value",
    [None, True, False, -(2**62), 0.1 + 0.2, math.inf, "球 \u2713", (), (1, "a", None), {"a": (1.5, {"b": ()})}],
)
def test_plain_values(value):
    assert there_and_back(value) == value


def test_a_plan_arrives_bit_by_bit_and_read_only():
    plan = a_plan(lab_site(), 3)
    came = there_and_back(plan)
    for name in ("t_s", "s", "q_mm"):
        assert getattr(came, name).tobytes() == getattr(plan, name).tobytes()
        assert not getattr(came, name).flags.writeable
    assert (came.plan_hash, came.axes, came.margins) == (plan.plan_hash, plan.axes, plan.margins)
    np.testing.assert_array_equal(came.correction.rotvec_rad, plan.correction.rotvec_rad)


def test_a_read_back_with_its_states_fault_and_missing_forces():
    states = (AxisState.ENABLED, AxisState.FAULT, AxisState.STOPPING)
    force = np.array([1.0, np.nan, -3.0])
    sent = Feedback(1.5, np.arange(3.0), -np.arange(3.0), force, states, np.zeros(3), fault=("A.Y", 0x8611, "lag"))
    came = there_and_back(sent)
    assert came.states == states
    assert came.fault == ("A.Y", 0x8611, "lag")
    assert came.at_limit is None
    assert math.isnan(came.path_time_s)
    np.testing.assert_array_equal(came.force_n, force)
    pressed = np.array([True, False, True])
    assert there_and_back(pressed).dtype == np.bool_
    np.testing.assert_array_equal(there_and_back(pressed), pressed)


def test_a_move_that_ended_in_a_fault_brings_its_cause():
    tables = ("position_mm", "following_error_mm", "force_n")
    trace = Trace(**{f.name: np.zeros((0, 3) if f.name in tables else 0) for f in fields(Trace)})
    cause = FollowingErrorTrip("A.X", "why", value=0.5, limit=0.1)
    stop = StopTimes(12.5, 12.51, math.inf)
    came = there_and_back(MoveResult("fault", 1.0, np.zeros(3), trace, np.zeros(3), 0.1, 2.0, cause, stop))
    assert came.stop == stop
    assert came.trace.position_mm.shape == (0, 3)
    assert isinstance(came.cause, FollowingErrorTrip)
    assert came.cause.text("zh") == cause.text("zh")


def every_error() -> list[type[DockingError]]:
    known = [kind for kind in vars(errors).values() if isinstance(kind, type) and issubclass(kind, DockingError)]
    found = [kind for kind in known if str(kind.code) in errors.catalogue("en")]
    assert len(found) > 40
    return found


@pytest.mark.parametrize("kind", every_error(), ids=lambda kind: kind.__name__)
def test_every_error_travels_with_its_class_and_facts(kind):
    error = kind.__new__(kind)
    DockingError.__init__(error, "A.X", "because", value=1.25, limit="less")
    came = there_and_back(error)
    assert type(came) is kind
    assert (came.where, came.cause, came.value, came.limit) == ("A.X", "because", 1.25, "less")


def test_an_error_of_the_program_arrives_as_a_defect():
    came = there_and_back(ZeroDivisionError("division by zero"))
    assert isinstance(came, Defect)
    assert "ZeroDivisionError: division by zero" in came.cause


def test_numbers_of_numpy_become_numbers():
    came = there_and_back(LeaseLost("cell", value=np.float64(0.5), limit=np.int64(3)))  # type: ignore[arg-type]
    assert (came.value, came.limit) == (0.5, 3)


def test_what_no_message_carries_is_an_error_of_the_sender():
    with pytest.raises(TypeError, match="set"):
        encode("x", 0, {1, 2})


WHOLE = encode("reply", 3, (Identity("A", "v", "p", "s", "f"), np.arange(6.0).reshape(2, 3), LeaseLost("x")))


def test_a_message_cut_short_anywhere_is_refused():
    for end in range(len(WHOLE)):
        with pytest.raises(BadReply):
            decode(WHOLE[:end])
        body = WHOLE[8:end]
        with pytest.raises(BadReply):
            decode(WHOLE[:4] + struct.pack("<I", len(body)) + body)


def test_another_version_or_program_is_refused():
    for head in (b"DM" + struct.pack("<H", VERSION + 1), b"XX" + WHOLE[2:4]):
        with pytest.raises(BadReply):
            decode(head + WHOLE[4:])
    with pytest.raises(BadReply):
        decode(WHOLE + b"N")

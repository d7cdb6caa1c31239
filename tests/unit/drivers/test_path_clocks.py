"""What read-backs in different scans tell of path times: never more than is true, and soon nearly all of it."""

from __future__ import annotations

import numpy as np
import pytest

from drivers.path_clocks import PathClock, Shown, apart_s

SCAN_S, RAMP_S, POLL_S, DRIFT = 0.01, 0.5, 0.05, 1e-4
GOLDEN = 0.618


class Controller:
    """Path time runs from `start_s` on at `rate`, in steps at its scans; from `pause_s` to `again_s` it stands.

    What begins or ends does so in a scan: the first one after the time given.
    """

    def __init__(self, start_s: float, phase_s: float, pause_s: float = 1e6, again_s: float = 1e6) -> None:
        self.phase_s = phase_s
        self.start_s, self.pause_s, self.again_s = (self.scan_after(t_s) for t_s in (start_s, pause_s, again_s))
        self.clock = PathClock(SCAN_S, RAMP_S, DRIFT)
        self.rate, self.stuck_s = 1.0, np.inf

    def scan_after(self, t_s: float) -> float:
        return float(np.ceil((t_s - self.phase_s) / SCAN_S)) * SCAN_S + self.phase_s

    def path_s(self, t_s: float) -> float:
        stood = min(max(t_s - self.pause_s, 0.0), self.again_s - self.pause_s)
        return self.rate * max(0.0, t_s - self.start_s - stood)

    def answer(self, asked_s: float, heard_s: float) -> None:
        scan = np.floor((min(0.5 * (asked_s + heard_s), self.stuck_s) - self.phase_s) / SCAN_S)
        scanned_s = scan * SCAN_S + self.phase_s
        stands = scanned_s < self.start_s - 1e-9 or self.pause_s - 1e-9 <= scanned_s < self.again_s - 1e-9
        shown = Shown(self.path_s(scanned_s), not stands, not stands, int(scan) & 0xFFFF, asked_s, heard_s)
        self.clock.see(shown, self.rate)


def polled(controllers: list[Controller], until_s: float, round_s: float = 0.001) -> np.ndarray:
    """Polls (n, 2): what is certain, and what is true, one controller read after the other."""
    t_s, rows, phase = 60.003, [], 0.0
    while t_s < until_s:
        for controller in controllers:
            controller.answer(t_s, t_s + round_s)
            t_s += 0.3 * round_s
        now_s = t_s + round_s
        true = [controller.path_s(now_s) for controller in controllers]
        rate = controllers[0].rate
        rows.append((apart_s([controller.clock for controller in controllers], now_s, rate), max(true) - min(true)))
        phase = (phase + GOLDEN) % 1.0
        t_s += POLL_S * (1.0 - 0.2 * phase)
    return np.array(rows)


@pytest.mark.parametrize("late_s", [0.0, 0.001, 0.009, 0.02, 0.1])
@pytest.mark.parametrize("rate", [1.0, 0.25])
def test_what_is_certain_is_true_and_comes_near_it(late_s: float, rate: float) -> None:
    phases = np.random.default_rng(2).uniform(0.0, SCAN_S, 4)
    controllers = [Controller(61.0 + (late_s if k == 2 else 0.0), phase) for k, phase in enumerate(phases)]
    for controller in controllers:
        controller.rate = rate
    certain, true = polled(controllers, 64.0).T
    assert (certain <= true + 1e-6).all()
    assert (true - certain)[-20:].max() <= 0.004 * rate


def test_a_controller_that_loses_time_on_the_way_is_seen_in_two_polls() -> None:
    controllers = [Controller(61.0, 0.001), Controller(61.0, 0.007, pause_s=62.5, again_s=62.54)]
    certain, true = polled(controllers, 64.0).T
    assert (certain <= true + 1e-6).all()
    lost = int(np.argmax(true > 0.045))
    assert certain[lost - 3] <= 0.0061
    assert certain[lost : lost + 2].max() >= 0.03
    assert certain[-1] == pytest.approx(0.046, abs=0.004)


def test_at_standstill_only_the_time_of_an_answer_is_uncertain() -> None:
    controllers = [Controller(61.0, 0.002, 62.0), Controller(61.0, 0.004, 62.013)]
    certain, true = polled(controllers, 63.0).T
    assert true[-1] == pytest.approx(0.01)
    assert true[-1] - 0.002 <= certain[-1] <= true[-1]


def test_a_controller_whose_scans_stand_still_says_nothing_of_path_time() -> None:
    controllers = [Controller(61.0, 0.002), Controller(61.0, 0.002)]
    controllers[1].stuck_s = 62.0
    certain, _ = polled(controllers, 63.0).T
    assert certain.max() <= 1e-6

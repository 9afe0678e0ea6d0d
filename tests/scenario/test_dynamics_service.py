"""The daemon as a process of its own: dynamics over the bus, its command, and ticks beside it."""

from __future__ import annotations

import json
import math
from collections.abc import Callable

import numpy as np
import pytest
from conftest import Daemon
from support_dynamics import CART
from support_lcm import invoke
from support_samples import VEHICLE

import modelserver as ms
from modelserver.errors import UnknownFrameError

pytest.importorskip("pinocchio", reason="pin has no wheel for this Python")

GEOMETRY = CART.replace("default: 0", "default: 0.1")
PUBLISH = "publish: {rate_hz: 50, health_hz: 20}\n"
DYNAMICS = "dynamics: {contacts: [Cart:FL, Cart:FR, Cart:RL, Cart:RR]}\n"


def test_given_daemon_with_dynamics_then_clients_and_command_get_them_and_ticks_go_on(
    start_daemon: Callable[..., Daemon],
) -> None:
    daemon = start_daemon(VEHICLE.partition("sensors:")[0] + PUBLISH + DYNAMICS, geometry=GEOMETRY)
    with ms.Platform(daemon.url) as platform:
        found = platform.get_dynamics("Cart:Base", equations=True)
        assert found.mass == pytest.approx(100.0)
        assert found.center == pytest.approx((0.0, 0.02, 0.6))
        assert np.array(found.mass_matrix) == pytest.approx([20.0])
        with pytest.raises(UnknownFrameError):
            platform.get_dynamics("Cart:Bace")
        for _ in range(50):
            platform.get_dynamics(equations=True)
    health = daemon.health(lambda each: each.requests_answered >= 52)
    assert health.stability.margin == pytest.approx(math.atan2(0.38, 0.6))
    assert health.handler_errors == 0
    done = invoke("", "dynamics", "Cart:Base", "--url", daemon.url, "--json", "--equations")
    assert json.loads(done.stdout)["mass"] == pytest.approx(100.0)
    shown = invoke("", "status", "--url", daemon.url)
    assert "tip-over margin static 32.3 deg" in shown.stdout

"""The simulated rig put together: clock, world, servos on their bus, lamp and camera, and the scenario that strikes them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from gonio.errors import ConfigurationError
from gonio.interfaces import Clock
from sim.camera import SimulatedCamera
from sim.clock import VirtualClock
from sim.dynamixel.bus import DynamixelBus
from sim.dynamixel.control_table import MODELS
from sim.dynamixel.servo import Servo
from sim.lamp import ScpiLamp
from sim.port import attach, detach
from sim.render import radiance
from sim.scenario import Scenario
from sim.settings import Settings
from sim.world import COUNTS_PER_TURN, Truth, World


class Simulation:
    """A simulated rig.

    Parameters
    ----------
    config : mapping, optional
        A parsed rig.toml; what is missing has defaults.
    clock : Clock, optional
        A `VirtualClock` of its own by default.
    scenario : Scenario, optional
        What goes wrong.

    Attributes
    ----------
    settings : Settings
    truth : Truth
    clock : Clock
    servos : dict of str to Servo
        By axis.
    bus : DynamixelBus
    lamp : ScpiLamp
    world : World
    camera : SimulatedCamera
    pull_cable : callable
        Disconnects the bus, for so many rig seconds (None for good), to come back under a name (None for the same).

    Examples
    --------
    >>> rig = Simulation()
    >>> urls = rig.attach("doctest-")
    >>> urls["bus"]
    'sim://doctest-bus'
    >>> rig.close()
    """

    def __init__(
        self,
        config: Mapping[str, Any] | None = None,
        *,
        clock: Clock | None = None,
        scenario: Scenario | None = None,
    ) -> None:
        self.settings = Settings.from_mapping(config)
        self.truth = Truth.draw(self.settings)
        self.clock: Clock = VirtualClock() if clock is None else clock
        self._scenario = scenario or Scenario()
        self._attached: list[str] = []
        self.pull_cable: Callable[[float | None, str | None], None] = self._detach_bus
        ids = {name: joint.servo_id for name, joint in self.settings.axes.items()}
        self.servos: dict[str, Servo] = {}
        for name, joint in self.settings.axes.items():
            if joint.model not in MODELS:
                raise ConfigurationError(
                    f"[axes.{name}] model = {joint.model!r} is not simulated; choose one of {', '.join(MODELS)}."
                )
            self.servos[name] = Servo(
                joint.servo_id,
                MODELS[joint.model],
                initial_counts=joint.zero_counts,
                backlash_counts=self.truth.backlash * COUNTS_PER_TURN / (2.0 * np.pi),
                friction_counts=self.truth.friction_counts,
                harmonics=self.truth.harmonics[name],
                load=self.truth.loads[name],
                supply_v=self.truth.supply_v,
                seed=self.settings.seed,
            )
        self.bus = DynamixelBus(self.servos.values(), self._scenario.known_to_servos(ids))
        self.lamp = ScpiLamp(
            drift_per_hour=self.truth.lamp_drift_per_hour,
            warm_up=self.truth.lamp_warm_up,
            channels=self.truth.lamp_channels,
        )
        self.world = World(self.settings, self.truth, self.servos, self.lamp)
        self.camera = SimulatedCamera(self.world, self.clock, self._strike)

    def attach(self, prefix: str = "") -> dict[str, str]:
        """Make bus and lamp reachable in this process; return their pyserial URLs by name.

        `prefix` tells several simulations in one process apart.
        """
        urls = {
            "bus": attach(f"{prefix}bus", self.bus, self.clock),
            "lamp": attach(f"{prefix}lamp", self.lamp, self.clock),
        }
        self._attached += [f"{prefix}bus", f"{prefix}lamp"]
        return urls

    def warm_up(self) -> None:
        """Compile what the first frame needs, so that it comes as fast as the others."""
        for specimen in ("white", "sample"):
            self.world.mount(specimen)
            lit = replace(self.world.scene(0.0), intensity=1.0)
            radiance(lit, self.camera.chip.eye, self.camera.chip.rays[:1])
        self.camera.chip.expose(np.zeros(self.camera.chip.shape), 1e-6, np.random.default_rng(0))

    def close(self) -> None:
        """Detach from the ``sim://`` URLs."""
        while self._attached:
            detach(self._attached.pop())

    def tick(self) -> None:
        """Let strike what is due by now, without a frame being asked for."""
        self._strike("")

    def _detach_bus(self, for_s: float | None, name: str | None) -> None:
        """Take the bus off its ``sim://`` URL."""
        for old in [attached for attached in self._attached if attached.endswith("bus")]:
            detach(old)
            self._attached.remove(old)
            if for_s is not None:
                self._attached.append(name or old)
                attach(self._attached[-1], self.bus, self.clock, self.clock.now() + for_s)

    def _strike(self, label: str) -> None:
        now = self.clock.now()
        for fault in self._scenario.due(label, self.camera.frames, now):
            if fault.kind == "disconnect":
                self.pull_cable(fault.options.get("for_s"), fault.options.get("return_as"))
            elif fault.kind in ("frame_torn", "frame_repeated"):
                self.camera.spoil = fault.kind.removeprefix("frame_")
            elif fault.kind == "lamp_out":
                self.lamp.burnt_out_at = now
            elif fault.kind == "lamp_silent":
                self.lamp.silent = True
            elif fault.kind == "camera_unplugged":
                self.camera.unplugged = True
            elif fault.axis is not None:
                self.bus.inject(fault.for_servo(self.servos[fault.axis].id, now))

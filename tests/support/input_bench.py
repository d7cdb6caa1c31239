"""One simulated I/O module with a contact and a temperature sensor, and the driver that reads it."""

from __future__ import annotations

from docking.config.inputs import CanModule, DigitalInput, InputsConfig, ModbusModule, TemperatureInput
from drivers.inputs import InputModule, WiredInputs
from tests.support.module_bench import ModuleBench

MODULE, CONTACT, SENSOR = "io1", "crane_free", "warm"
NODE = 40
_MODULES = {
    "cia401": CanModule(kind="cia401", name=MODULE, node=NODE),
    "modbus-io": ModbusModule(kind="modbus-io", name=MODULE, host="127.0.0.1", port=15040),
}


class Bathtub:
    """A plant with one temperature."""

    celsius = 23.4

    def temperatures_c(self, t_s: float) -> dict[str, float]:
        return dict.fromkeys(("component", "mate", "floor"), self.celsius)


class InputBench(ModuleBench[WiredInputs]):
    """The module of one kind and what it is wired to."""

    def __init__(self, kind: str) -> None:
        inputs = InputsConfig(
            modules=(_MODULES[kind],),
            digital=(DigitalInput(name=CONTACT, module=MODULE, channel=9, debounce_s=0.02),),
            temperatures=(TemperatureInput(name=SENSOR, of="component", module=MODULE, channel=1, sigma_k=1e-6),),
        )
        super().__init__(inputs, Bathtub())

    def driver(self, module: InputModule) -> WiredInputs:
        return WiredInputs(self.inputs, {MODULE: module})

    def hold(self, given: bool) -> None:
        self.world.hold(CONTACT, given)

    def warm(self, celsius: float) -> None:
        self.plant.celsius = celsius

    def break_sensor(self, broken: bool) -> None:
        self.world.break_sensor(SENSOR, broken)

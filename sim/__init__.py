"""The far end of the wires: simulated devices around one plant. Shares no mathematics with `docking` or `drivers`."""

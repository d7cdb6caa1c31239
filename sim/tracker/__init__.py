"""Simulated tracking instruments: the far end of the serial line, around one `sim.instrument.Instrument`."""

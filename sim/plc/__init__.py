"""The far end of the Modbus wires: positioner PLCs with a segment FIFO and two common lines, around one plant."""

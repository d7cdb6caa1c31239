"""The far end of the Modbus wires: positioner PLCs with a segment FIFO and one common RUN line, around one plant."""

"""CANopen drives (CiA 301, CiA 402) over any CAN link: bring-up, group enabling, cyclic set-points, monitoring."""

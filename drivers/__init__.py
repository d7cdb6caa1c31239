"""Bytes <-> ports: one seam per wire in `links`, pure codecs, sequences with deadlines, register and object maps as data."""

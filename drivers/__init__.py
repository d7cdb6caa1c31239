"""Bytes <-> ports: one seam per wire in `links`, pure codecs, sequences with deadlines, maps as data in `maps`."""

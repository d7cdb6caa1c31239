"""Where the operator's camera is in the cell ([Huo]): markers, map, localisation, what is drawn for a person."""

"""Words for people: message catalogues, one file a language."""

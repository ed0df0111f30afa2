"""Studies: cases × scenarios × training seeds, from a TOML file to a report."""

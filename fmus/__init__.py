"""The evaporator as FMUs: C sources, variable table, build and reference signals."""

"""Co-simulation of an FMU plant with a controller: scenarios, closed loop, records, results."""

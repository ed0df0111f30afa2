"""Ground of all packages: scenario, signals, protocols, statistics, files, errors."""

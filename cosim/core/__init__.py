"""What every other package stands on: scenario, signals, protocols, statistics, files, errors."""

"""What several test modules share: problems, plants, controllers, oracles."""

"""What a run is made of: its folder, its cadences, its evaluation, its way to stop."""

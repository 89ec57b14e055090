"""Many runs by one command, each with its own process and folder, so that sweeps can continue."""

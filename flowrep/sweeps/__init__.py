"""Many runs by one command: each a process and a folder of its own, so that a sweep can go on."""

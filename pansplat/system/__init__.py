"""Files, JSON, caches, threads, the console and checks of code: what is the same in any program."""

"""Work that takes the interpreter for long: it runs in other processes, bounded in time and in memory."""

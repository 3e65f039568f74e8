"""Work that takes long: it runs in other processes, with limits on time and memory."""

"""Who may use a server: addresses, pages, keys."""

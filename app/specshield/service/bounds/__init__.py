"""What one caller may take of the server: connections, headers, bytes of bodies, time to send them."""

"""What is to be known of bus, clock and machine before one relies on them."""

"""Where robots stand, and what is thrown at them."""

"""The safety filter: the smallest change to a wished velocity that keeps robots and obstacles apart."""

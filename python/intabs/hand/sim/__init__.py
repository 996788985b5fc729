"""A simulated hand that performs the tasks before a colour camera and a depth camera."""

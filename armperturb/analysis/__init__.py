"""What a recording means; runs on recordings of people as well, so it never imports the simulator."""

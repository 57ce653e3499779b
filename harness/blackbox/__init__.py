"""FMUs as nominal models: equations unknown, effects around them, simulated from any start."""

"""What arrives: rigs, frames, and their synchronisation."""

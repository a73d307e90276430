"""What is remembered: keyframes, landmarks, observations, states."""

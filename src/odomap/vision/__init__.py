"""Front-ends for cameras: features, matching, flow, stereo."""

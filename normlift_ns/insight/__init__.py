"""What an answer rests on: how relevancies are spread, which photographs voted, which Gaussians belong to nothing."""

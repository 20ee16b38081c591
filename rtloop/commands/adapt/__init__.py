"""What `rtloop ctl learn` and `rtloop ctl retune` do: a running loop measured, and told what follows from it."""

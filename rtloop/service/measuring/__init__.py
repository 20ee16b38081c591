"""What a service plays on a loop that runs, to measure it, to learn a scan, and to make its taps anew."""

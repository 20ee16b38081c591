"""The supervisor of loop and recorder: starts them, keeps them alive with a heartbeat, and parks what they leave."""

"""The driver `udp` and a node in network namespaces, with `tc netem` between them."""

"""The node graph as processes of this machine: configuration, supervision, transport, doctor."""

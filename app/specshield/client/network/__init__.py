"""The SDK on the network: connections with limits in time, requests by httpx, and streams."""

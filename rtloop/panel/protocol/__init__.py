"""Messages between the panel and a page: subscriptions come as JSON, frames are sent as binary messages."""

"""The one interface for every client: HTTP, JSON and WebSocket over a unix socket, and TCP when asked for.

Import what you need from the module that has it (:func:`graderd.api.app.make_app`, :func:`graderd.api.server.serve`):
the configuration takes its settings from here, and the guard, which must speak soon, needs the configuration and no web
framework.
"""

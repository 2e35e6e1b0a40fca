"""One file a resource; its bodies stand beside the routes that use them."""

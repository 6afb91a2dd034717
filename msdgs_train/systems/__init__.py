"""Complete systems by name, the published ones included: settings and the class that trains them."""

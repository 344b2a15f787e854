// Browsers start no worker on pages that are opened as files. There, a hidden frame runs the search's worker.
if (location.protocol === "file:") {
  window.Worker = class extends EventTarget {
    constructor(url) {
      super()
      this.onmessage = null
      this.frame = document.createElement("iframe")
      this.frame.hidden = true
      this.frame.srcdoc = "<!doctype html><title>search</title><body></body>"
      const opened = new Promise(resolve => this.frame.addEventListener("load", resolve))
      document.body.appendChild(this.frame)
      this.ready = opened.then(() => {
        const inside = this.frame.contentWindow
        inside.postMessage = data => this.answer(data)
        inside.importScripts = (...urls) => Promise.all(urls.map(one => this.load(one)))
        return this.load(url)
      })
    }

    load(url) {
      return new Promise((resolve, reject) => {
        const script = this.frame.contentDocument.createElement("script")
        script.src = url
        script.onload = resolve
        script.onerror = () => reject(new Error(`cannot read ${url}`))
        this.frame.contentDocument.body.appendChild(script)
      })
    }

    answer(data) {
      const event = new MessageEvent("message", { data })
      this.dispatchEvent(event)
      if (this.onmessage) this.onmessage(event)
    }

    postMessage(data) {
      this.ready.then(() => {
        const inside = this.frame.contentWindow
        inside.dispatchEvent(new inside.MessageEvent("message", { data }))
      })
    }

    terminate() {
      this.frame.remove()
    }
  }
}
